"""A broken plug-in costs its own command only; folders that hide packages are found."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1]
PLUGINS = {
    "raises": "raise RuntimeError('half installed')",
    "exits": "raise SystemExit(3)",
    "number": "command = 3",
    "unusable": "def command(argument: 'Nope') -> None: ...",
    "syntax": "def command(:",
}


def noiseflow(*words: str, folder: Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    search = os.pathsep.join([*([] if path is None else [str(path)]), str(SOURCES)])
    return subprocess.run(
        [sys.executable, "-m", "noiseflow", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": search, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an installed package of broken plug-ins, and a sound one that takes the name of a command of ours."""
    folder = tmp_path_factory.mktemp("site")
    information = folder / "others-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    for name, text in PLUGINS.items():
        (folder / f"plugin_{name}.py").write_text(text + "\n")
    (folder / "plugin_sound.py").write_text(
        'def command(name: str) -> None:\n    """Greets."""\n    print("hello", name)\n'
    )
    points = [f"{name} = plugin_{name}:command" for name in (*PLUGINS, "absent", "sound")]
    lines = ["[noiseflow.commands]", *points, "sample = plugin_sound:command"]
    lines += ["[noiseflow.noise_models]", "Broken = plugin_raises:Model"]
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_help_and_other_commands_work_beside_broken_plugins(site: Path, tmp_path: Path) -> None:
    done = noiseflow("-h", folder=tmp_path, path=site)
    assert done.returncode == 0, done.stderr
    for name in (*PLUGINS, "absent", "sound", "reconstruct"):
        assert f" {name} " in done.stdout
    assert "half installed" in done.stdout
    assert noiseflow("sound", "world", folder=tmp_path, path=site).stdout == "hello world\n"
    assert "Noise-model file" in noiseflow("sample", "-h", folder=tmp_path, path=site).stdout


@pytest.mark.parametrize("name", [*PLUGINS, "absent"])
def test_a_broken_plugin_says_so_in_one_line(name: str, site: Path, tmp_path: Path) -> None:
    done = noiseflow(name, "word", "--option", folder=tmp_path, path=site)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "plug-in" in done.stderr or "package others" in done.stderr


def test_a_broken_noise_model_warns_and_others_load(site: Path, tmp_path: Path) -> None:
    program = "import noiseflow; noiseflow.load(noiseflow.save(noiseflow.Gaussian(), 'model.safetensors'))"
    path = os.pathsep.join([str(site), str(SOURCES)])
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "'Broken' of the package others cannot be loaded" in done.stderr


def test_doctor_names_broken_plugins(site: Path, tmp_path: Path) -> None:
    done = noiseflow("doctor", "--json", folder=tmp_path, path=site)
    assert done.returncode == 1
    problems = json.loads(done.stdout.splitlines()[-1])["problems"]
    assert sum("package others" in problem for problem in problems) >= 4


@pytest.mark.parametrize("whole", [False, True])
def test_a_folder_of_our_names_in_the_working_directory_hides_nothing(whole: bool, tmp_path: Path) -> None:
    for name in ("recon", "torch"):
        (tmp_path / name).mkdir()
        if whole:
            (tmp_path / name / "__init__.py").write_text("raise RuntimeError('the wrong one')\n")
    done = noiseflow("compare", "-h", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Fourier shell correlation" in done.stdout


def test_doctor_tells_what_is_hidden_by_the_search_path(tmp_path: Path) -> None:
    for name in ("recon", "tifffile"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    done = noiseflow("doctor", "--json", folder=tmp_path, path=tmp_path)
    result = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 1
    assert not result["healthy"]
    assert result["folders"]["recon"] == result["folders"]["tifffile"] == str(tmp_path)
    shadows = [problem for problem in result["problems"] if problem.startswith("shadow: ")]
    assert [line.split()[1] for line in shadows] == ["recon", "tifffile"]
