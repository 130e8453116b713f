"""The report in a real browser: sliders move slices, the swipe works, and nothing leaves the page.

The tests of the page itself need Chromium and Playwright (the extra `test`, and a `chromium` on the path).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from noiseflow.checks import Verdict
from noiseflow.report import Chart, Report, make_sprites, provenance
from recon.methods._registry import reconstruct
from recon.report.charts import error_bar_figure
from recon.report.page import even_odd, reconstruction_report
from recon.series.tilt_series import Volume, VolumeGrid
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

SIZE = 20
USER_TEXT = "<script>alert(1)</script></script><b>&\"'"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]


def unpacked(sprites):
    """The grey values of a stack of sprites, as a browser would find them."""
    count, height, width = sprites.shape
    sections = []
    for sheet in sprites.sheets:
        image = cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_GRAYSCALE)
        tiles = image.reshape(image.shape[0] // height, height, sprites.columns, width).transpose(0, 2, 1, 3)
        sections.append(tiles.reshape(-1, height, width)[: sprites.per_sheet])
    return np.concatenate(sections)[:count]


@pytest.mark.parametrize("shape", [(1, 5, 7), (70, 300, 200), (3, 1, 2048)])
def test_lossless_sprites_hold_every_grey_value(shape):
    stack = np.indices(shape).sum(0) % 251 + 1000.0
    sprites = make_sprites(stack)
    assert sprites.lossless
    expected = (stack - stack.min()) * (255 / (stack.max() - stack.min()))
    np.testing.assert_allclose(unpacked(sprites), expected, atol=0.51)


def test_sprites_keep_their_budget_and_say_how_they_were_made_smaller():
    stack = np.random.default_rng(0).standard_normal((16, 128, 128))
    sprites = make_sprites(stack, most_bytes=20_000)
    assert sprites.num_bytes <= 20_000
    assert sprites.shape != stack.shape
    assert "16 × 128 × 128" in sprites.in_words()
    views = make_sprites(stack, most_bytes=20_000, keep_sections=True)
    assert views.shape[0] == 16
    assert views.num_bytes <= 20_000


def test_smaller_sprites_are_averages():
    stack = np.repeat(np.repeat(np.arange(64.0).reshape(4, 4, 4), 2, 1), 2, 2).repeat(2, 0)
    noise = np.tile(np.array([[-1.0, 1.0], [1.0, -1.0]]), (8, 4, 4)) * 20
    sprites = make_sprites(stack + noise, most_bytes=200, limits=(0.0, 63.0))
    assert sprites.shape == (4, 4, 4)
    np.testing.assert_allclose(unpacked(sprites), np.arange(64).reshape(4, 4, 4) * (255 / 63), atol=6)


@pytest.mark.parametrize(("stack", "words"), [(np.zeros((2, 2)), "shape"), (np.full((2, 2, 2), np.nan), "NaN")])
def test_sprites_refuse_what_they_cannot_draw(stack, words):
    with pytest.raises(ValueError, match=words):
        make_sprites(stack)


def test_user_text_is_escaped_everywhere(tmp_path):
    report = Report(USER_TEXT, USER_TEXT)
    report.heading(USER_TEXT)
    report.text(USER_TEXT)
    report.text(USER_TEXT, kind="command")
    report.facts([(USER_TEXT, USER_TEXT)])
    report.table((USER_TEXT,), [(USER_TEXT,)], caption=USER_TEXT)
    report.widget("volume", {"text": USER_TEXT}, caption=USER_TEXT)
    chart = Chart(USER_TEXT, x=USER_TEXT)
    chart.plot([0, 1], [1, 2], label=USER_TEXT)
    report.charts([chart], caption=USER_TEXT)
    page = report.save(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert "<b>" not in page
    stored = re.search(r'<script type="application/json">(.*?)</script>', page).group(1)
    assert json.loads(stored) == {"text": USER_TEXT}


def test_page_names_no_address_outside_itself(tmp_path):
    report = Report("page")
    chart = Chart("chart")
    chart.plot([0, 1], [1, 2])
    report.charts([chart], caption="chart")
    page = report.save(tmp_path / "page.html").read_text(encoding="utf-8")
    sources = re.findall(r"(?:src|href|url)\s*[=(]\s*[\"']?([^\"')\s>]+)", page)
    assert all(source.startswith(("data:", "#", "{")) or source == "source;" for source in sources), sources


def test_provenance_gives_the_checksum_of_the_input(tmp_path):
    path = tmp_path / "input.bin"
    path.write_bytes(b"noise")
    rows = dict(provenance([path, tmp_path / "absent"], seed=7))
    assert rows["seed"] == "7"
    assert (
        rows["input: input.bin"] == "5 bytes, SHA-256 efe2a5c09e6d49d7eb735c9875f77404be5b887bb3f56378038968d4e3ff8198"
    )
    assert "torch" in rows["versions"]


def test_provenance_of_a_folder_is_that_of_its_images(tmp_path):
    for number in (10, 9):
        np.save(tmp_path / f"{number}.npy", np.full((4, 4), number))
    (tmp_path / "notes.txt").write_text("not read")
    both = (tmp_path / "9.npy").read_bytes() + (tmp_path / "10.npy").read_bytes()
    expected = f"2 files, {len(both)} bytes, SHA-256 {hashlib.sha256(both).hexdigest()}"
    assert dict(provenance([tmp_path]))[f"input: {tmp_path.name}"] == expected
    assert dict(provenance([f"{tmp_path}/9.npy::image"]))["input: 9.npy::image"].startswith(f"{len(both) // 2} bytes")


def test_included_report_keeps_its_pictures_under_its_own_title(tmp_path):
    inner = Report("inner & more")
    inner.heading("Part", folded=True)
    inner.widget("volume", {"text": "</main>"}, caption="inner")
    outer = Report("outer")
    outer.include(inner.save(tmp_path / "inner.html"))
    page = outer.save(tmp_path / "outer.html").read_text(encoding="utf-8")
    assert "<h2>inner &amp; more</h2>" in page
    assert "<h3>Part</h3>" in page
    assert page.count("</main>") == 1
    assert page.count("<details>") == page.count("</details>") == 2


def test_even_and_odd_tilts_are_all_tilts_once():
    series = clean_tilt_series(np.ones((8, 8, 8), np.float32), 10 * np.arange(7.0), acquisition=ACQUISITIONS["none"])[0]
    even, odd = even_odd(series)
    assert sorted([*even.tilt_angles, *odd.tilt_angles]) == [10 * number for number in range(7)]
    np.testing.assert_array_equal(odd.images, series.images[1::2])


@pytest.fixture(scope="module")
def scene():
    """A volume whose slices differ along every axis, its noisy tilt series and a quick joint fit."""
    z, y, x = np.indices((SIZE, SIZE, SIZE), dtype=np.float32) / SIZE
    volume = (0.2 + x + 2 * y * z) * (np.hypot(x - 0.5, z - 0.5) < 0.4)
    acquisition = ACQUISITIONS["clipped"]
    clean, _ = clean_tilt_series(volume.astype(np.float32), np.arange(-60.0, 61, 6), acquisition=acquisition)
    noisy = replace(add_noise(clean, acquisition.noise(), seed=0), pixel_size=20.0)
    return noisy, reconstruct(noisy, VolumeGrid.of(noisy), weight=0.4, num_steps=10, uncertainty=2)


@pytest.fixture(scope="module")
def page_path(scene, tmp_path_factory):
    noisy, outcome = scene
    folder = tmp_path_factory.mktemp("report")
    path = folder / "tilts <b>&.mrc"
    path.write_bytes(b"data")
    reference = Volume(outcome.volume.attenuation[:, ::-1].copy())
    effect = {"value": 1.0, "null": 0.0, "error": 0.2, "tolerance": 2.0, "cost": 0.5}
    verdict = Verdict("doubtful", ("the first reason", "the second"), {f"effect {i}": effect for i in range(15)})
    more = {"inputs": [path], "seed": 3, "reference": reference, "verdict": verdict}
    report = reconstruction_report(noisy, outcome, [("method", "joint")], **more)
    return report.save(folder / "index.html")


def test_report_of_a_classical_method_has_no_noise_to_show(scene, tmp_path):
    noisy, _ = scene
    outcome = reconstruct(noisy, VolumeGrid.of(noisy), method="wbp")
    page = reconstruction_report(noisy, outcome, []).save(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<h2>Volume</h2>" in page
    assert "<h2>Noise</h2>" not in page


@pytest.mark.slow
def test_report_of_256_voxels_stays_under_15_megabytes(tmp_path):
    rng = np.random.default_rng(0)
    report = Report("large")
    sprites = make_sprites(rng.standard_normal((256, 256, 256), dtype=np.float32))
    report.widget("volume", {"sprites": sprites.as_json()}, caption="")
    tilts = make_sprites(rng.standard_normal((160, 256, 256), dtype=np.float32), keep_sections=True)
    report.widget("tilts", {"sprites": tilts.as_json()}, caption="")
    assert report.save(tmp_path / "page.html").stat().st_size < 13_000_000


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("no Chromium on the path")
    if not os.environ.get("CI"):
        pytest.importorskip("playwright.sync_api", reason="needs playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield started
        started.close()


@pytest.fixture
def open_page(browser, page_path):
    """Opens the report; afterwards there must have been no error and no request outside."""
    faults, contexts = [], []

    def open_it(**options):
        context = browser.new_context(**{"viewport": {"width": 1200, "height": 900}, **options})
        contexts.append(context)
        page = context.new_page()
        page.on(
            "console", lambda message: faults.append(message.text) if message.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: faults.append(request.url) if not inside(request.url) else None)
        page.goto(page_path.as_uri())
        page.wait_for_selector("html[data-ready]")
        return page

    def inside(url):
        return url.startswith("data:") or url == page_path.as_uri()

    yield open_it
    for context in contexts:
        context.close()
    assert not faults


def shown(page, label):
    """The grey values of a canvas."""
    script = """canvas => ({size: [canvas.height, canvas.width],
        grey: [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data].filter((_, i) => i % 4 == 1)})"""
    found = page.locator(f"canvas[aria-label='{label}']").evaluate(script)
    return np.array(found["grey"]).reshape(found["size"])


def move(page, label, value):
    page.get_by_label(label, exact=True).first.evaluate(
        "(input, value) => { input.value = value; input.dispatchEvent(new Event('input')); }", value
    )


def test_slices_show_the_volume_where_the_sliders_stand(open_page, scene):
    page = open_page()
    volume = scene[1].volume.attenuation
    for axis, label, cut in (
        ("z", "slice xy", volume[5]),
        ("y", "slice xz", volume[:, 7]),
        ("x", "slice yz", volume[:, :, 9]),
    ):
        before = shown(page, label)
        move(page, axis, {"z": 5, "y": 7, "x": 9}[axis])
        after = shown(page, label)
        assert not np.array_equal(before, after)
        # the curve is monotone and stretches the contrast: the same order, and black and white at the ends
        assert np.corrcoef(after.ravel(), np.clip(cut, *np.percentile(volume, (0.5, 99.8))).ravel())[0, 1] > 0.999


def test_contrast_sliders_change_the_curve(open_page):
    page = open_page()
    before = shown(page, "slice xy").mean()
    move(page, "white", 40)
    assert shown(page, "slice xy").mean() > before + 5


def test_a_click_in_one_slice_moves_the_others(open_page):
    page = open_page()
    before = shown(page, "slice xz")
    box = page.locator("canvas[aria-label='slice xy']").bounding_box()
    page.mouse.click(box["x"] + box["width"] * 0.5, box["y"] + box["height"] * 0.8)
    assert not np.array_equal(before, shown(page, "slice xz"))
    assert page.get_by_label("y", exact=True).first.input_value() == str(int(0.8 * SIZE))


def test_error_bars_stand_beside_the_volume_and_name_what_no_tilt_saw(open_page, scene):
    page = open_page()
    picture = page.get_by_alt_text("standard deviation and bias from 2 samples")
    assert picture.evaluate("image => image.complete && image.naturalWidth") > 800
    assert "No tilt between 60° and 120° was recorded (33 % of 180°)" in page.locator("main").inner_text()
    _, outcome = scene
    figure = error_bar_figure(outcome.volume, outcome.uncertainty, "attenuation per voxel")
    *panels, bar = (axis for axis in figure.axes if axis.get_ylabel() != "")
    drawn = {axis.get_title(): axis.images[0] for axis in panels if axis.get_title() in ("standard deviation", "bias")}
    assert drawn["standard deviation"].get_clim() == drawn["bias"].get_clim()
    assert bar.get_ylabel() == "attenuation per voxel"
    np.testing.assert_array_equal(drawn["bias"].get_array(), outcome.uncertainty.bias.attenuation[SIZE // 2])


def test_tilts_play_and_the_swipe_uncovers_the_prediction(open_page, scene):
    page = open_page()
    outcome = scene[1]
    move(page, "tilt", 3)
    seen = shown(page, "clean projection")
    assert np.corrcoef(seen.ravel(), outcome.projections[3].ravel())[0, 1] > 0.99
    swipe = page.get_by_label("swipe")
    box = swipe.bounding_box()
    swipe.click(position={"x": box["width"] * 0.25, "y": box["height"] / 2})
    split = page.locator("canvas.over").evaluate("canvas => getComputedStyle(canvas).clipPath")
    assert 20 < float(re.search(r"([\d.]+)%\)", split).group(1)) < 30
    first = shown(page, "data")
    page.get_by_role("button", name="Play tilts").click()
    page.wait_for_timeout(400)
    page.get_by_role("button", name="Stop tilts").click()
    assert not np.array_equal(first, shown(page, "data"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_follows_light_and_dark(open_page, scheme):
    page = open_page(color_scheme=scheme)
    paper = page.locator("body").evaluate("element => getComputedStyle(element).backgroundColor")
    text = page.locator(".charts text").first.evaluate("element => getComputedStyle(element).fill")
    brightness = [np.mean([int(part) for part in re.findall(r"\d+", colour)[:3]]) for colour in (paper, text)]
    assert (brightness[0] > brightness[1]) == (scheme == "light")
    assert abs(brightness[0] - brightness[1]) > 120


def test_the_first_screen_shows_verdict_effects_and_volume(open_page):
    page = open_page(viewport={"width": 1400, "height": 900})
    for part in (".doubtful", "ol li >> nth=1", ".charts svg", "canvas[aria-label='slice xy']", ".scale-bar"):
        box = page.locator(part).first.bounding_box()
        assert box["y"] + box["height"] < 900, part


def test_page_fits_a_phone(open_page):
    page = open_page(viewport={"width": 390, "height": 844}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.locator("canvas[aria-label='slice xy']").bounding_box()["width"] > 300


def test_page_prints_its_pictures_without_controls(open_page):
    page = open_page()
    page.emulate_media(media="print", color_scheme="light")
    assert page.get_by_label("z", exact=True).first.is_hidden()
    assert page.locator("canvas[aria-label='slice xy']").is_visible()
    assert len(page.pdf()) > 20_000


def test_page_names_its_contents_and_its_file_as_text(open_page):
    page = open_page()
    assert page.locator("h1").inner_text() == "Reconstruction of tilts <b>&.mrc"
    links = page.locator(".contents a").all_inner_texts()
    assert links == [
        "Verdict",
        "Volume",
        "Error bars",
        "Tilt series",
        "Differences of each image",
        "Noise",
        "Convergence",
        "Resolution",
        "Settings and choices",
        "Methods, to paste into a paper",
        "Provenance",
    ]


def test_folded_parts_open_by_their_link_and_numbers_and_charts_are_saved(open_page):
    page = open_page()
    settings = page.locator("details", has=page.get_by_role("heading", name="Settings and choices"))
    assert settings.locator("table").is_hidden()
    page.locator(".contents a", has_text="Settings and choices").click()
    assert settings.locator("table").is_visible()
    with page.expect_download() as numbers:
        settings.get_by_role("button", name="CSV").click()
    assert numbers.value.suggested_filename == "settings_and_choices.csv"
    assert '"setting","value","evidence"' in numbers.value.path().read_text(encoding="utf-8")
    page.locator(".contents a", has_text="Noise").click()
    with page.expect_download() as chart:
        page.locator("details[open] button", has_text="SVG").first.click()
    assert "var(--" not in chart.value.path().read_text(encoding="utf-8")


def test_resolution_is_drawn_of_halves_and_reference_alike(scene, tmp_path):
    noisy, outcome = scene
    half = Volume(outcome.volume.attenuation[:, ::-1].copy())
    outcome = replace(outcome, volume=replace(outcome.volume, voxel_size=20.0))
    report = reconstruction_report(noisy, outcome, [], halves=(half, outcome.volume), reference=half)
    page = report.save(tmp_path / "index.html").read_text(encoding="utf-8")
    assert "Between even and odd tilts it" in page
    assert "Between volume and reference it" in page
    cycles, period = map(float, re.findall(r"up to (0\.\d+) cycles per voxel \(([\d.]+) nm\)", page)[0])
    assert period == pytest.approx(2.0 / cycles, rel=0.02)


def test_legends_hide_no_data():
    chart = Chart("chart", x="place")
    chart.plot([0, 1], [1, 2], label="data")
    low = [float(y) for y in re.findall(r'y="([\d.]+)"[^>]*>(?:place|data)<', chart.svg())]
    assert low[1] > low[0] + 8


def test_figures_on_cards_stay_on_one_line(browser, tmp_path):
    values = (
        "good",
        "2.0046 counts/e⁻",
        "2.008 (1.967 … 2.049)",
        "104.9 (81.61 … 122.8)",
        "Poisson-Gaussian corrected by a flow",
    )
    report = Report("Cards")
    report.facts([(f"figure {number}", value) for number, value in enumerate(values)])
    page = browser.new_page(viewport={"width": 1200, "height": 600})
    page.goto(report.save(tmp_path / "cards.html").as_uri())
    heights = page.evaluate(
        "[...document.querySelectorAll('.facts dd')].map(d => d.offsetHeight / parseFloat(getComputedStyle(d).lineHeight))"
    )
    assert len(heights) == len(values)
    assert max(heights) < 1.5
    assert page.evaluate("document.documentElement.scrollWidth") <= 1200
    page.close()
