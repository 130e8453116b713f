"""The direction of the imports: noiseflow knows nothing of calibration and recon, and these nothing of each other."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {"noiseflow": {"calibration", "recon"}, "calibration": {"recon"}, "recon": {"calibration"}}
FRONT = ROOT / "recon" / "commands" / "benchmark.py"
"""The one shipped file that imports the folder `benchmarks`, which is not shipped."""


@cache
def nodes(file: Path) -> list[ast.Import | ast.ImportFrom]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported(file: Path) -> set[str]:
    names: set[str] = set()
    for node in nodes(file):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("package", FORBIDDEN)
def test_imports_go_one_way(package: str) -> None:
    files = [*(ROOT / package).rglob("*.py"), *(ROOT / package).rglob("*.pyi")]
    assert files
    for file in files:
        unshipped = {"tests", "docs", "benchmarks"} if file != FRONT else set()
        assert not imported(file) & (FORBIDDEN[package] | unshipped), file


@pytest.mark.parametrize(
    ("words", "unwanted"),
    [
        (["-h"], {"torch", "scipy", "matplotlib", "cv2"}),
        (["calibrate", "--help"], {"torch", "scipy", "matplotlib", "cv2", "recon"}),
        (["reconstruct", "--help"], {"torch", "scipy", "matplotlib", "cv2", "calibration"}),
    ],
)
def test_help_imports_neither_torch_nor_another_command_s_package(words: list[str], unwanted: set[str]) -> None:
    code = (
        "import sys; from noiseflow.commands.cli import main\n"
        f"try: main({words})\nexcept SystemExit as end: assert not end.code\nsys.exit(bool({unwanted} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert "Usage" in shown.stdout


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_files(file: Path, known: dict[str, Path]) -> set[Path]:
    """The project's files that a file imports anywhere in it, in functions and for types too."""
    found: set[Path] = set()
    for node in nodes(file):
        if isinstance(node, ast.Import):
            found |= {known[alias.name] for alias in node.names if alias.name in known}
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name for name in members if name in known} or ({node.module} & set(known))
            found |= {known[name] for name in modules}
    return found


def test_no_file_imports_a_file_that_imports_it() -> None:
    files = [file for package in FORBIDDEN for file in (ROOT / package).rglob("*.py")]
    known = {module_name(file): file for file in files if file.name != "__init__.py"}
    graph = {file: imported_files(file, known) - {file} for file in files}
    assert sum(map(len, graph.values())) > len(files)
    remaining = dict(graph)
    while remaining:  # files without imports among those that remain are taken away, until none or a circle is left
        leaves = [file for file, imports in remaining.items() if not imports & set(remaining)]
        assert leaves, sorted(str(file.relative_to(ROOT)) for file in remaining)
        for file in leaves:
            del remaining[file]
