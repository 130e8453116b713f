"""Runs the code of the tutorials, as their readers do, and keeps the pictures.

python docs/tutorials/run.py [NAME ...]
"""

import contextlib
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent / "images" / "tutorials"


def run(page: Path) -> list[str]:
    """Run all Python blocks of a page, one after the other, in the working folder; what each of them printed."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    namespace: dict[str, object] = {"__name__": page.stem}
    printed = []
    for number, block in enumerate(blocks, 1):
        with contextlib.redirect_stdout(io.StringIO()) as text:
            exec(compile(block, f"{page.name}, block {number}", "exec"), namespace)
        printed.append(text.getvalue())
    return printed


@contextlib.contextmanager
def empty_folder() -> Iterator[Path]:
    """Work in an empty folder for a while."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield Path(folder)
        finally:
            os.chdir(before)


if __name__ == "__main__":
    with_code = [page for page in HERE.glob("*.md") if "```python" in page.read_text(encoding="utf-8")]
    for name in sys.argv[1:] or sorted(page.stem for page in with_code):
        with empty_folder() as folder:
            print(*run(HERE / f"{name}.md"), sep="\n")
            for picture in folder.glob("*.png"):
                (PICTURES / picture.name).write_bytes(picture.read_bytes())
                print(f"wrote {PICTURES / picture.name}")
