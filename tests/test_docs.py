"""The documentation tells the truth: its code runs, its commands exist, and no public name is missing."""

from __future__ import annotations

import importlib
import pkgutil
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import typer.main

import noiseflow
from noiseflow import io
from noiseflow.commands.cli import build_app
from recon.names import FIELDS, METHODS, REGULARISERS

ROOT = Path(__file__).parent.parent
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs" / "guide").glob("*.md"), *TUTORIALS])
PACKAGES = ("noiseflow", "calibration", "recon")
QUICK = ("files.md", "report.md", "cite.md", "index.md")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def commands() -> list[tuple[str, str]]:
    """(page, line) of every call of the program."""
    lines = [(page.name, line) for page in PAGES for block in blocks(page, "sh") for line in block.splitlines()]
    return [(page, line) for page, line in lines if line.startswith("noiseflow ")]


@pytest.fixture
def folder(tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the few files that the pages speak of, from the shipped data."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(data / "exposures_miro" / "channel1_050ms.tif", "short.tif")
    shutil.copy(data / "exposures_miro" / "channel1_long.tif", "long.tif")
    io.write("clean.tif", np.linspace(110, 250, 4096, dtype=np.float32).reshape(64, 64))
    needle = io.read(data / "tilt_needle" / "needle_aligned.mrc")
    io.write("tilts.mrc", needle.data[:, 24:32], voxel_size=needle.voxel_size)
    shutil.copy(data / "tilt_needle" / "needle_aligned.rawtlt", "tilts.rawtlt")
    moved = [
        np.roll(image, shift, axis=1) for image, shift in zip(needle.data, [0, 1] * len(needle.data), strict=False)
    ]
    io.write("raw.mrc", np.stack(moved), voxel_size=needle.voxel_size)
    shutil.copy("tilts.rawtlt", "raw.rawtlt")
    noiseflow.save(noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0), "detector.safetensors")
    return tmp_path


@pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.name, marks=[] if page.name in QUICK else [pytest.mark.slow]) for page in PAGES]
)
def test_python_blocks_run_page_by_page(page: Path, folder: Path) -> None:
    namespace: dict[str, object] = {"__name__": page.stem}
    for number, block in enumerate(blocks(page, "python"), 1):
        exec(compile(block, f"{page.name}, block {number}", "exec"), namespace)
    assert ("```python" not in page.read_text(encoding="utf-8")) or set(namespace) - {"__name__", "__builtins__"}


@pytest.mark.parametrize(("page", "line"), commands(), ids=lambda value: value.replace(" ", "_")[:60])
def test_commands_of_the_pages_parse(page: str, line: str) -> None:
    words = shlex.split(re.split(r" [>|] ", line)[0], comments=True)[1:]
    program = typer.main.get_command(build_app())
    if words == ["-h"]:
        return
    if words[-1] == "-h":
        words.pop()
        assert words[0] in program.commands or words[0] == "COMMAND"
        return
    command = program.commands[words[0]]
    with command.make_context(words[0], words[1:]) as context:
        assert context.params


def sections() -> list[tuple[str, set[str]]]:
    """(module, names listed) of the reference."""
    found = []
    for page in sorted((ROOT / "docs" / "api").glob("*.md")):
        for section in page.read_text(encoding="utf-8").split(".. currentmodule:: ")[1:]:
            found.append((section.split("\n", 1)[0], set(re.findall(r"^   (\w+)$", section, flags=re.MULTILINE))))
    return found


def public_names(module: ModuleType) -> set[str]:
    """What a package exports, or what a module (or a folder of modules) defines."""
    if module.__name__ in PACKAGES:
        return {name for name in module.__all__ if not isinstance(getattr(module, name), ModuleType)}
    stub = Path(str(module.__file__)).with_suffix(".pyi")
    if stub.is_file():  # it names what is public, whichever file defines it
        names = set(re.findall(r" as (\w+)$", stub.read_text(encoding="utf-8"), flags=re.MULTILINE))
        return {name for name in names if callable(getattr(module, name))}
    homes = {name: f"{getattr(getattr(module, name), '__module__', '')}." for name in dir(module)}
    return {name for name, home in homes.items() if home.startswith(f"{module.__name__}.") and name[0] != "_"}


@pytest.mark.parametrize(("module_name", "listed"), sections(), ids=[name for name, _ in sections()])
def test_reference_lists_exactly_the_public_names(module_name: str, listed: set[str]) -> None:
    module = importlib.import_module(module_name)
    public = public_names(module)
    assert public
    assert not public - listed, f"not in docs/api: {sorted(public - listed)}"
    assert not [name for name in listed if not hasattr(module, name)]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_and_their_public_modules_have_a_section(package: str) -> None:
    whole = importlib.import_module(package)
    modules = {f"{package}.{name}" for name in whole.__all__ if isinstance(getattr(whole, name), ModuleType)}
    assert {package} | modules <= {name for name, _ in sections()}


def test_every_page_is_linked_and_every_link_leads_somewhere() -> None:
    for page in [*PAGES, *(ROOT / "docs").glob("*.md"), ROOT / "docs" / "gallery" / "index.md"]:
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists() or (page.parent / f"{target}.md").exists(), f"{page.name}: {target}"
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert all(f"guide/{page.stem}\n" in index for page in PAGES if page.parent.name == "guide")


GALLERY = ROOT / "docs" / "gallery"
DRAWN = sorted(path.stem for path in GALLERY.glob("*.py") if path.stem != "drawing")
DRAWN_SOON = {"noise_of_a_camera", "pit", "run_time"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in DRAWN_SOON else [pytest.mark.slow]) for name in DRAWN]
)
def test_gallery_draws_its_pictures(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = tmp_path / ("picture.svg" if name in ("geometry", "import_graph") else "picture.png")
    monkeypatch.setattr(sys, "argv", [name, str(picture)])
    monkeypatch.syspath_prepend(str(GALLERY))
    runpy.run_path(str(GALLERY / f"{name}.py"), run_name="__main__")
    assert picture.stat().st_size > 4_000


def test_gallery_lists_every_program_once_and_each_shows_its_small_picture() -> None:
    page = (GALLERY / "index.md").read_text(encoding="utf-8")
    groups = [
        re.findall(r"^   gallery/(\w+)\.py$", part, flags=re.MULTILINE) for part in page.split("minigallery::")[1:]
    ]
    listed = [name for group in groups for name in group]
    assert len(groups) == 2
    assert sorted(listed) == [
        name for name in DRAWN if name != "import_graph"
    ]  # the page of the architecture shows that
    shown = set()
    for name in listed:
        program = (GALLERY / f"{name}.py").read_text(encoding="utf-8")
        (picture,) = re.findall(r"^\.\. image:: /(images/\S+)$", program, flags=re.MULTILINE)
        assert f'# sphinx_gallery_thumbnail_path = "{picture}"\n' in program, name
        shown.add(ROOT / "docs" / picture)
    pictures = {*(ROOT / "docs" / "images" / "gallery").glob("*.png")}
    assert len(pictures) >= 16
    assert pictures < shown
    assert all(picture.is_file() for picture in shown)
    pictures |= {*(ROOT / "docs" / "images" / "tutorials").glob("*.png")}
    assert all(picture.stat().st_size < 150_000 for picture in pictures)


@pytest.mark.parametrize(
    ("name", "picture"),
    [("pit", "gallery/pit.png"), ("overview", "overview.png"), ("geometry", "geometry.svg")],
)
def test_gallery_programs_draw_the_committed_picture_by_default(
    name: str, picture: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "docs" / "gallery"
    copy.mkdir(parents=True)
    (tmp_path / "docs" / "images" / "gallery").mkdir(parents=True)
    shutil.copy(GALLERY / "drawing.py", copy)
    monkeypatch.setattr(sys, "argv", [f"{name}.py"])
    call = re.findall(r"^    main\(.*\)$", (GALLERY / f"{name}.py").read_text(encoding="utf-8"), flags=re.MULTILINE)
    drawing = runpy.run_path(str(copy / "drawing.py"))
    exec(call[0].strip(), {"main": drawing["main"], "draw": lambda: drawing["new_figure"]()[0]})
    assert (tmp_path / "docs" / "images" / picture).is_file()


def test_reference_explains_every_option_of_every_command() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "command_reference.py"))["page"]()
    program = typer.main.get_command(build_app())
    for name, section in zip(program.commands, page.split("\n## noiseflow ")[1:], strict=True):
        assert section.startswith(f"{name}\n")
        rows = {
            option: row for row in section.splitlines() for option in re.findall(r"`(--?[\w-]+)`", row.split(" | ")[0])
        }
        for parameter in program.commands[name].params:
            if parameter.param_type_name == "option":
                assert all(len(rows[option].split(" | ")[-1].strip(" |")) > 10 for option in parameter.opts), (
                    parameter.name
                )
    assert not re.findall(r"(?<![`\w-])--[a-z]", re.sub(r"`[^`]*`", "", page)), "a dash in place of two hyphens"


def test_every_screenshot_is_taken_by_the_script_and_shown() -> None:
    script = (ROOT / "docs" / "screenshots.py").read_text(encoding="utf-8")
    guide = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = sorted((ROOT / "docs" / "images" / "screenshots").glob("*.png"))
    assert len(pictures) >= 6
    for picture in pictures:
        assert f'"{picture.stem}"' in script
        assert f"images/screenshots/{picture.name})" in guide
        assert picture.stat().st_size < 200_000


def test_settings_of_the_pages_name_installed_extensions_only() -> None:
    pytest.importorskip("sphinx", reason="needs the extra [docs]")
    settings = runpy.run_path(str(ROOT / "docs" / "conf.py"))
    assert settings["extensions"]
    assert [importlib.import_module(extension).__name__ for extension in settings["extensions"]] == settings[
        "extensions"
    ]


def test_pages_are_drawn_in_their_theme(tmp_path: Path) -> None:
    """`make docs-check` builds them in a plain one."""
    theme = runpy.run_path(str(ROOT / "docs" / "conf.py"))["html_theme"]
    (tmp_path / "index.rst").write_text("Title\n=====\n\nText.\n")
    build = pytest.importorskip("sphinx.cmd.build", reason="needs the extra [docs]").main
    assert build(["-q", "-W", "-C", "-D", f"html_theme={theme}", str(tmp_path), str(tmp_path / "html")]) == 0
    assert f"{theme}.css" in (tmp_path / "html" / "index.html").read_text(encoding="utf-8")


def test_denoiser_named_in_the_guide_takes_an_image() -> None:
    from recon.denoise import find_denoiser

    code = "".join(blocks(ROOT / "docs" / "guide" / "extend.md", "sh"))
    (named,) = re.findall(r"--denoiser (\S+)", code)
    images = np.random.default_rng(0).random((2, 12, 14), dtype=np.float32)
    assert find_denoiser(named, images)(images[0]).shape == (12, 14)


def test_benchmark_pages_name_the_commit_of_their_figures() -> None:
    add = runpy.run_path(str(ROOT / "docs" / "page_dates.py"))["add"]
    for page in sorted({*(ROOT / "docs" / "benchmarks").glob("*.md")} - {ROOT / "docs" / "benchmarks" / "index.md"}):
        source = [page.read_text(encoding="utf-8")]
        add(None, f"benchmarks/{page.stem}", source)
        assert re.search(r"commit [0-9a-f]{7}", source[0]), page.name
    untouched = ["text"]
    add(None, "guide/files", untouched)
    assert untouched == ["text"]


@pytest.mark.parametrize("page", ["architecture.md", "guide/change.md", "guide/extend.md"])
def test_paths_and_names_of_the_developers_pages_exist(page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    quoted = set(re.findall(r"(?<!\})`([\w./]+)`", text))
    paths = {each for each in quoted if "/" in each and not each.startswith("/")}
    missing = [path for path in paths if not (ROOT / path.removesuffix("NAME.py")).exists()]
    assert missing == []
    groups = {registry.group for registry in (METHODS, FIELDS, REGULARISERS)}  # of entry points: no modules
    for name in quoted - paths - groups:
        if name.partition(".")[0] in PACKAGES and "." in name:
            pkgutil.resolve_name(name)


def test_the_tree_of_the_architecture_is_that_of_the_packages() -> None:
    tree = blocks(ROOT / "docs" / "architecture.md", "text")[0]
    rooms = re.split(r"^(?=\w)", tree, flags=re.MULTILINE)[1:]
    for room in rooms:
        top = ROOT / room.partition("/")[0]
        named = set(re.findall(r"\b(\w+)/", room.partition("/")[2])) & {*(each.name for each in top.rglob("*/"))}
        assert top.is_dir()
        if top.name in PACKAGES:
            assert named >= {each.parent.name for each in top.glob("*/__init__.py")}, top
            assert set(re.findall(r"^  (\w+\.py)", room, re.MULTILINE)) <= {each.name for each in top.glob("*.py")}
    assert {room.partition("/")[0] for room in rooms} >= {*PACKAGES, "benchmarks", "tests", "docs"}
