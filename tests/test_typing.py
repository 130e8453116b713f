"""The public types: a user's program passes `mypy --strict`."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_a_user_program_type_checks() -> None:
    program = Path(__file__).parent / "typing" / "user_program.py"
    # errors inside of installed packages are not the user's, and are not reported; `make check` reports ours
    options = ["--strict", "--config-file=", "--ignore-missing-imports", "--follow-imports=silent"]
    command = [sys.executable, "-m", "mypy", *options, str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=program.parents[2])
    assert done.returncode == 0, done.stdout
