"""Takes the screenshots of the guide: the reports in Chromium, and napari where it is installed and has a screen.

python docs/screenshots.py [report] [calibration] [napari]    # all of them if none is named

The reports need Playwright (the extra `test`) and a `chromium` on the path; napari its extra and a screen, or `xvfb-run`.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from noiseflow.installation import DISTRIBUTION

PICTURES = Path(__file__).resolve().parent / "images" / "screenshots"
EXPOSURES = "exposures_miro/channel1_050ms.tif", "exposures_miro/channel1_long.tif"
COLOURS = 48  # of a palette: text stays sharp, and a picture below 150 kB


def take_report(folder: Path) -> None:
    """The report of a simulated series: verdict, volume, tilt series, noise."""
    _noiseflow("simulate", folder / "series", "--size", "64")
    series, report = folder / "series" / "tilts.mrc", folder / "report"
    _noiseflow("reconstruct", series, "-o", folder / "volume.mrc", "--report", report, "--uncertainty", "8", "--fsc")
    _take_sections(
        report / "index.html", {"verdict": None, "volume": "Volume", "tilts": "Tilt series", "noise": "Noise"}
    )


def take_calibration(folder: Path) -> None:
    """The report of the exposures that ship with the library."""
    import noiseflow

    short, long = (Path(noiseflow.__file__).parent / "data" / name for name in EXPOSURES)
    report = folder / "calibration"
    _noiseflow("calibrate", "--short", short, "--long", long, "-o", folder / "model.safetensors", "--report", report)
    _take_sections(report / "report.html", {"calibration": None})


def take_napari(_: Path) -> None:
    """The viewer with a reconstructed volume, its verdict and the form of the plugin."""
    import napari.qt

    import noiseflow
    from recon.napari import widget

    needle = Path(noiseflow.__file__).parent / "data" / "tilt_needle" / "needle_aligned.mrc"
    viewer = napari.Viewer(show=True)
    viewer.window.resize(1280, 720)
    (tilts,) = viewer.open([needle], plugin=DISTRIBUTION)
    viewer.window.add_plugin_dock_widget(DISTRIBUTION, "Reconstruct a tilt series")
    widget._show(viewer, tilts, widget.reconstruct_layers(tilts.data, tilts.metadata, method="sirt"))
    for _ in range(20):
        viewer.reset_view()
        napari.qt.get_qapp().processEvents()
    _save(viewer.screenshot(canvas_only=False, flash=False), "napari")
    viewer.close()


def _noiseflow(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "noiseflow", *map(str, words)], check=True)


def _take_sections(page_file: Path, sections: dict[str, str | None]) -> None:
    """Screenshots of a report, from the headings named on, unfolded; of its top where there is none."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 1100, "height": 720}, color_scheme="light")
        page.goto(page_file.as_uri())
        page.wait_for_selector("html[data-ready]")
        for name, heading in sections.items():
            if heading:
                page.get_by_role("heading", name=heading, exact=True).evaluate(
                    "found => { const fold = found.closest('details'); if (fold) fold.open = true;"
                    " found.scrollIntoView({behavior: 'instant'}); }"
                )
                page.wait_for_timeout(500)  # charts of an opened section are drawn then
            _save(page.screenshot(), name)
        browser.close()


def _save(picture: object, name: str) -> None:
    image = Image.open(io.BytesIO(picture)) if isinstance(picture, bytes) else Image.fromarray(picture)  # type: ignore[arg-type]
    PICTURES.mkdir(parents=True, exist_ok=True)
    image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(PICTURES / f"{name}.png", optimize=True)
    print(f"wrote {PICTURES / name}.png")


if __name__ == "__main__":
    known = {"report": take_report, "calibration": take_calibration, "napari": take_napari}
    for chosen in sys.argv[1:] or known:
        with tempfile.TemporaryDirectory() as scratch:
            known[chosen](Path(scratch))
