"""How large the packages are: lines, files, numeric constants with and without a name, and functions that exist twice.

python -m tests.counts [FOLDER]    # another checkout, to compare with
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from dataclasses import astuple, dataclass, fields
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("noiseflow", "calibration", "recon")
# Values whose meaning needs no name: nothing, one, two, a half and a guard against division by zero.
PLAIN = {0, 1, 2, 0.5, 1e-30}
# Shorter functions are alike by chance.
LEAST_STATEMENTS = 3


@dataclass
class Counts:
    """Counts of one package.

    Attributes:
        lines, files: of Python source.
        small: files of fewer than 60 lines.
        named: numeric constants of modules and classes.
        defaults: numbers that are defaults of arguments, without 0, 1, 2, ½ and 10⁻³⁰.
        inline: other numbers in code, without these.
        twice: functions whose body is that of an earlier one, names of variables aside.
    """

    lines: int = 0
    files: int = 0
    small: int = 0
    named: int = 0
    defaults: int = 0
    inline: int = 0
    twice: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool)


def named_in(body: list[ast.stmt]) -> tuple[int, set[ast.AST]]:
    """Number of numeric constants assigned in a module or class body, and the nodes of their values."""
    count, values = 0, set[ast.AST]()
    for statement in body:
        value = getattr(statement, "value", None)
        if isinstance(statement, (ast.Assign, ast.AnnAssign)) and value is not None:
            numbers = [node for node in ast.walk(value) if is_number(node)]
            parts = value.elts if isinstance(value, ast.Tuple) else [value]
            count += sum(any(is_number(node) for node in ast.walk(part)) for part in parts)
            values |= set(numbers)
        elif isinstance(statement, ast.ClassDef):
            more, inner = named_in(statement.body)
            count, values = count + more, values | inner
    return count, values


def shape_of(function: ast.FunctionDef) -> str:
    """The body without the names of local variables and the docstring."""
    names: dict[str, str] = {}
    body = function.body[1:] if ast.get_docstring(function) else function.body
    copied = ast.parse(ast.unparse(ast.Module(body, [])))
    for node in ast.walk(copied):
        if isinstance(node, ast.Name):
            node.id = names.setdefault(node.id, str(len(names)))
    return ast.dump(copied)


def count_files(files: list[Path]) -> Counts:
    """Counts of some files, taken together."""
    total, seen = Counts(), Counter[str]()
    for file in files:
        source = file.read_text(encoding="utf-8")
        tree = ast.parse(source)
        named, values = named_in(tree.body)
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        defaults = {
            node for f in functions for d in [*f.args.defaults, *f.args.kw_defaults] if d for node in ast.walk(d)
        }
        inline = [
            node
            for node in ast.walk(tree)
            if is_number(node) and node not in values | defaults and node.value not in PLAIN
        ]
        seen.update(shape_of(f) for f in functions if len(f.body) >= LEAST_STATEMENTS)
        lines = source.count("\n")
        given = sum(is_number(node) and node.value not in PLAIN for node in defaults)
        total += Counts(lines, 1, lines < 60, named, given, len(inline))
    total.twice = seen.total() - len(seen)
    return total


def count(root: Path = ROOT) -> dict[str, Counts]:
    """Counts by package."""
    return {package: count_files(sorted((root / package).rglob("*.py"))) for package in PACKAGES}


def main() -> None:
    """Print a table."""
    found = count(Path(sys.argv[1]) if sys.argv[1:] else ROOT)
    rows = found | {"together": sum(found.values(), Counts())}
    print(f"{'':12}" + "".join(f"{field.name:>9}" for field in fields(Counts)))
    for name, counts in rows.items():
        print(f"{name:12}" + "".join(f"{value:9}" for value in astuple(counts)))


if __name__ == "__main__":
    main()
