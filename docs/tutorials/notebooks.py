"""Writes each tutorial as a notebook, docs/tutorials/generated/NAME.ipynb, from its page; Sphinx calls it on each build.

The page is the one source: its Python blocks are the notebook's code, its text the cells between them. A page without
Python is a page of commands, and its shell blocks are the code.

python docs/tutorials/notebooks.py [--run]    # --run: with what the code prints and draws, for a few minutes
"""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

HERE = Path(__file__).resolve().parent
FOLDER = HERE / "generated"
PAGES = sorted(page for page in HERE.glob("*.md") if page.stem != "index")
NEEDS = "*A tutorial of noiseflow; its one requirement is `pip install noiseflow-microscopy`.*"
BLOCK = re.compile(r"^```(python|sh|\{literalinclude\})([^\n]*)\n(.*?)^```\n", flags=re.DOTALL | re.MULTILINE)
INCLUDED = re.compile(r"^```\{include\} (\S+)\n:start-after: (.+)\n:end-before: \"?(.+?)\"?\n```", flags=re.MULTILINE)
SAVED = re.compile(r'^figure\.savefig\("([^"]+)"', flags=re.MULTILINE)
SHOW = '\n\nfrom IPython.display import Image\n\nImage("{}")'


def write(*, run: bool = False) -> None:
    """Write all notebooks; those whose data ship with the library run first, if asked for."""
    FOLDER.mkdir(exist_ok=True)
    for page in PAGES:
        whole = notebook(page)
        if run and "```python" in page.read_text(encoding="utf-8"):
            add_outputs(whole, page)
        nbformat.validate(whole)
        nbformat.write(whole, FOLDER / f"{page.stem}.ipynb")


def notebook(page: Path) -> nbformat.NotebookNode:
    """The notebook of a page, not run."""
    text = page.read_text(encoding="utf-8")
    wanted = ("python",) if "```python" in text else ("sh", "{literalinclude}")
    cells, position = [], 0
    for found in BLOCK.finditer(text):
        if found[1] in wanted:
            cells += [_words(text[position : found.start()], page), new_code_cell(_code(found, page))]
            position = found.end()
    cells = [cell for cell in [*cells, _words(text[position:], page)] if cell.source]
    cells.insert(0, new_markdown_cell(NEEDS))
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"  # in place of a random one: the same page gives the same file
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel})


def add_outputs(whole: nbformat.NotebookNode, page: Path) -> None:
    """Run the page, and put what it printed and drew below the cells."""
    from run import empty_folder
    from run import run as printed_by

    with empty_folder() as folder:
        code = [cell for cell in whole.cells if cell.cell_type == "code"]
        for cell, printed in zip(code, printed_by(page), strict=True):
            cell.outputs = [new_output("stream", name="stdout", text=printed)] if printed else []
            for name in SAVED.findall(cell.source):
                cell.outputs.append(new_output("display_data", data={"image/png": _encoded(folder / name)}))


def _code(block: re.Match[str], page: Path) -> str:
    """Python as it is, and its picture shown; commands behind exclamation marks; an included program in a file."""
    language, name, body = block[1], block[2].strip(), block[3].rstrip("\n")
    if language == "python":
        return body + "".join(SHOW.format(picture) for picture in SAVED.findall(body))
    if language == "sh":
        return "\n".join(f"!{line}" for line in body.splitlines())
    return f"%%writefile {name}\n{(page.parent / name).read_text(encoding='utf-8')}"


def _words(text: str, page: Path) -> nbformat.NotebookNode:
    """A text cell that stands alone: pictures inside it, other pages by their titles, included parts in full."""
    text = INCLUDED.sub(lambda found: _part(page.parent / found[1], found[2], found[3]), text)
    pictures = re.findall(r"!\[[^\]]*\]\(([^):\s]+)\)", text)
    for path in pictures:
        text = text.replace(f"({path})", f"(attachment:{Path(path).name})")
    text = re.sub(r"(?<!!)\[([^\]]+)\]\([^):\s]+\)", r"*\1*", text)
    text = re.sub(r"\{doc\}`([^`]+)`", lambda found: f"*{_title(page.parent / f'{found[1]}.md')}*", text)
    cell = new_markdown_cell(text.strip("\n"))
    if pictures:
        cell.attachments = {Path(path).name: {"image/png": _encoded(page.parent / path)} for path in pictures}
    return cell


def _part(page: Path, start: str, end: str) -> str:
    return page.read_text(encoding="utf-8").split(start, 1)[1].split(end, 1)[0].strip()


def _encoded(picture: Path) -> str:
    return base64.b64encode(picture.read_bytes()).decode("ascii")


def _title(page: Path) -> str:
    return page.read_text(encoding="utf-8").split("\n", 1)[0].removeprefix("# ")


def write_for_sphinx(*_: Any) -> None:
    """Write all notebooks before a build, and run them where the build is CI's or asks for it."""
    run = ["--run"] if os.environ.get("CI") or os.environ.get("RUN_TUTORIALS") else []
    subprocess.run([sys.executable, __file__, *run], check=True)  # a process of its own: it changes the folder


def link(_: Any, name: str, source: list[str]) -> None:
    """Offer the notebook below the heading of the page."""
    stem = name.removeprefix("tutorials/")
    if name.startswith("tutorials/") and stem in [page.stem for page in PAGES]:
        heading, rest = source[0].split("\n", 1)
        source[0] = f"{heading}\n\n{{download}}`Download this page as a notebook <generated/{stem}.ipynb>`\n{rest}"


if __name__ == "__main__":
    write(run="--run" in sys.argv[1:])
