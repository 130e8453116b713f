"""The tutorials: a notebook of each page, and printed lines that the program prints."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "tutorials"
PAGES = sorted(page for page in FOLDER.glob("*.md") if page.stem != "index")
RAW = ROOT.parent / "shared" / "data" / "tilt_needle_256"
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def notebooks() -> dict[str, Any]:
    pytest.importorskip("nbformat", reason="needs the extra [docs]")
    return runpy.run_path(str(FOLDER / "notebooks.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_notebook_is_valid_and_has_the_code_of_its_page(notebooks: dict[str, Any], page: Path) -> None:
    import nbformat

    whole = notebooks["notebook"](page)
    nbformat.validate(whole)
    code = [cell.source for cell in whole.cells if cell.cell_type == "code"]
    if blocks(page, "python"):
        assert len(code) == len(blocks(page, "python"))
        for cell, block in zip(code, blocks(page, "python"), strict=True):
            assert cell.startswith(block.rstrip("\n"))
            compile(cell, page.name, "exec")
    else:
        commands = "".join(blocks(page, "sh")).splitlines()
        assert [line[1:] for cell in code for line in cell.splitlines() if line.startswith("!")] == commands


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_notebook_stands_alone(notebooks: dict[str, Any], page: Path) -> None:
    """Its pictures are inside it, and it links to no file of the repository."""
    text = [cell for cell in notebooks["notebook"](page).cells if cell.cell_type == "markdown"]
    assert sum(cell.source.count("# ") > 0 for cell in text) >= 2
    for cell in text:
        for target in re.findall(r"\]\(([^)]+)\)", cell.source):
            assert target.startswith("https://") or target.removeprefix("attachment:") in cell.attachments
        assert "{doc}" not in cell.source


def test_notebook_that_ran_holds_what_was_printed_and_drawn(
    notebooks: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    page = tmp_path / "page.md"
    draw = 'from noiseflow.report import new_figure\n\nfigure, _ = new_figure()\nfigure.savefig("a.png")\n'
    page.write_text(f"# Title\n\n```python\nprint(2 + 3)\n```\n\nText.\n\n```python\n{draw}```\n", encoding="utf-8")
    whole = notebooks["notebook"](page)
    before = Path.cwd()
    notebooks["add_outputs"](whole, page)
    first, second = (cell.outputs for cell in whole.cells if cell.cell_type == "code")
    assert first[0].text == "5\n"
    assert list(second[0].data) == ["image/png"]
    assert Path.cwd() == before


def assert_printed(shown: str, printed: str) -> str:
    """The words are among those printed, with the same numbers to 2 %: another number of threads rounds differently. Returns
    what was printed after them."""
    words, printed = " ".join(shown.split()), " ".join(printed.split())
    pattern = "(.+?)".join(map(re.escape, NUMBER.split(words)))
    found = re.search(pattern.replace("(.+?)", f"({NUMBER.pattern})"), printed)
    assert found, f"not printed: {words!r}\n{printed}"
    numbers = [float(number) for number in NUMBER.findall(words)]
    assert [float(number) for number in found.groups()] == pytest.approx(numbers, rel=0.02, abs=0.02)
    return printed[found.end() :]


def test_check_of_printed_lines_finds_other_words_and_other_numbers() -> None:
    assert_printed("gain 2.50 (2.4 to 2.6)", "first\ngain 2.51 (2.4\nto 2.6)\nlast")
    for shown in ("gains 2.51", "gain 2.61"):
        with pytest.raises(AssertionError):
            assert_printed(shown, "gain 2.51 counts")


@pytest.mark.slow
def test_camera_page_shows_what_its_code_prints(monkeypatch: pytest.MonkeyPatch) -> None:
    run = runpy.run_path(str(FOLDER / "run.py"))
    with run["empty_folder"]():
        printed = "".join(run["run"](FOLDER / "camera.md"))
    for line in "".join(blocks(FOLDER / "camera.md", "text")).splitlines():
        printed = assert_printed(line.removesuffix("..."), printed)


@pytest.mark.slow
def test_raw_series_page_shows_what_its_commands_print(tmp_path: Path) -> None:
    if not RAW.exists():
        pytest.skip("the raw series is not at hand")
    for suffix in ("mrc", "rawtlt", "txt"):
        shutil.copy(RAW / f"needle_256_raw.{suffix}", tmp_path)
    page = FOLDER / "raw_series.md"
    printed = ""
    for command in blocks(page, "sh")[:2]:
        words = [sys.executable, "-m", *shlex.split(command.split(" > ")[0])]
        printed += subprocess.run(
            words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ).stdout
    for shown in blocks(page, "text"):
        assert_printed(shown, printed)


def test_included_tables_stand_in_the_notebook(notebooks: dict[str, Any]) -> None:
    text = "".join(cell.source for cell in notebooks["notebook"](FOLDER / "blocks.md").cells)
    assert "{include}" not in text
    assert "| shells-1000" in text
    assert "| slab-128" not in text
