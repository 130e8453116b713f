"""The direction of the imports: noiseflow knows nothing of calibration and recon, and these nothing of each other."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {"noiseflow": {"calibration", "recon"}, "calibration": {"recon"}, "recon": {"calibration"}}


def imported(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
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
        assert not imported(file.read_text()) & FORBIDDEN[package], file


def test_help_answers_without_torch() -> None:
    code = (
        "import sys; from noiseflow.commands.cli import build_app; build_app(); "
        "sys.exit(any(name in sys.modules for name in ('torch', 'scipy', 'matplotlib', 'cv2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
