"""The public types: a user's program passes `mypy --strict`."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_a_user_program_type_checks() -> None:
    program = Path(__file__).parent / "typing" / "user_program.py"
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--ignore-missing-imports", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=program.parents[2])
    assert done.returncode == 0, done.stdout
