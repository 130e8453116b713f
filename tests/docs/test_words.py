"""The words of the pages, the help texts and the messages are the field's own, not an idiom of ours."""

from __future__ import annotations

import ast
import io
import re
import runpy
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
        *(page for page in (ROOT / "docs").rglob("*.md") if "generated" not in page.parts),
    ]
)
SOURCES = sorted(path for package in ("noiseflow", "calibration", "recon") for path in (ROOT / package).rglob("*.py"))

# A pattern of what not to write, and what to write in its place.
WORDS = {
    r"readings|(?:a|an|each|every|noisy|clipped|mean|stored) reading\b(?! of (?:a |the )?file)": "pixel value, measured value",
    r"rails?|rail's": "clipping limit, saturation",
    r"told": "reported, stated",
    r"rivals?": "baseline, other methods",
    r"lattices?|lattice's": "voxel grid",
    r"best for the truth": "tuned against the ground truth",
    r"none beats": "whose held-out likelihood is within one standard error of the best",
    r"goes on where it was|go on where it was": "interrupted runs resume",
    r"must tell": "required inputs",
    r"skipping (?:nothing|everything)": "all accelerations off / on",
    r"asks nothing of a network": "works offline",
}
ANY = re.compile(rf"\b(?:{'|'.join(WORDS)})\b", flags=re.IGNORECASE)
# What the patterns find and the field says itself.
ALLOWED = re.compile(
    r"(?:crystal|atomic|Bravais|reciprocal) lattices?|rivals, slow-rivals|docs/benchmarks/rivals\.py|the stage's own readings",
    re.IGNORECASE,
)


def without_code(text: str) -> str:
    """Markdown without its code, addresses and directives."""
    text = re.sub(r"^(`{3,})[^\n]*\n.*?^\1", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"``[^`]*``|`[^`]*`|\]\([^)]*\)", "", text)


def misused(text: str) -> list[str]:
    """The words to replace, with the better ones."""
    text = ALLOWED.sub("", text)
    if not ANY.search(text):
        return []
    return [
        f"{found.group()!r} (write: {better})"
        for pattern, better in WORDS.items()
        for found in re.finditer(rf"\b(?:{pattern})\b", text, flags=re.IGNORECASE)
    ]


def messages(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of the sentences in a program that are not docstrings: errors, help texts, labels."""
    tree = ast.parse(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        sentence = isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip()
        if sentence and id(node) not in docstrings:
            yield node.lineno, node.value


def comments(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of comments and docstrings, without the names of arguments in them."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT or token.string.startswith(('"""', 'r"""')):
            yield token.start[0], re.sub(r"^ *\w+: |`[^`]*`|>>> .*", "", token.string, flags=re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_pages_use_the_words_of_the_field(page: Path) -> None:
    assert misused(without_code(page.read_text(encoding="utf-8"))) == []


def test_help_texts_use_the_words_of_the_field() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "command_reference.py"))["page"]()
    assert misused(without_code(page)) == []


def test_messages_use_the_words_of_the_field() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {word}"
        for path in SOURCES
        for line, text in messages(path.read_text(encoding="utf-8"))
        for word in misused(text)
    ]
    assert not found, "\n".join(found)


def test_docstrings_and_comments_use_the_words_of_the_field() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {word}"
        for path in SOURCES
        for line, text in comments(path.read_text(encoding="utf-8"))
        for word in misused(text)
    ]
    assert not found, "\n".join(found)


def test_the_check_finds_and_forgives() -> None:
    assert misused("The readings lie on the rails; what was told holds.") != []
    assert len(misused("clipped readings are at a rail")) == 2
    assert not misused("reading a file of a crystal lattice; the stage's reading of the angle; threefold")
    assert not misused(
        without_code("run `rivals` and see [the page](rivals.md)\n```sh\nnoiseflow benchmark rivals\n```\n")
    )
    source = '"""Doc.\n\nArgs:\n    rails: the rails.\n"""\n# `told`, not told\n'
    assert sum(len(misused(text)) for _, text in comments(source)) == 2
    assert [text for _, text in messages('"""told"""\nraise ValueError(f"{a} was told")')] == [" was told"]
