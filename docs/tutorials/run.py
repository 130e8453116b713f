"""Runs the code of the tutorials, as their readers do, and keeps the pictures.

python docs/tutorials/run.py [NAME ...]
"""

import os
import re
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent / "images" / "tutorials"


def run(page: Path) -> None:
    """Run all Python blocks of a page, one after the other, in the working folder."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    namespace: dict[str, object] = {"__name__": page.stem}
    for number, block in enumerate(blocks, 1):
        exec(compile(block, f"{page.name}, block {number}", "exec"), namespace)


if __name__ == "__main__":
    with_code = [page for page in HERE.glob("*.md") if "```python" in page.read_text(encoding="utf-8")]
    for name in sys.argv[1:] or sorted(page.stem for page in with_code):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            run(HERE / f"{name}.md")
            for picture in Path().glob("*.png"):
                (PICTURES / picture.name).write_bytes(picture.read_bytes())
                print(f"wrote {PICTURES / picture.name}")
            os.chdir(HERE)
