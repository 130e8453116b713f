"""What is shipped: wheel and sdist build, are small, carry licences, and the wheel's demo needs no checkout."""

from __future__ import annotations

import importlib.metadata
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from noiseflow import installation
from noiseflow.installation import DISTRIBUTION

ROOT = Path(__file__).parent.parent


def test_constraints_pin_everything_the_tests_install() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {canonicalize_name(line.split("==")[0]) for line in lines if "==" in line}
    pending, seen = [(DISTRIBUTION, "test")], set()
    while pending:
        name, extra = pending.pop()
        seen.add((name, extra))
        try:
            requirements = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # of another platform, or not needed by this one
        for requirement in map(Requirement, requirements):
            if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
                continue
            wanted = [(canonicalize_name(requirement.name), each) for each in ("", *requirement.extras)]
            pending += [each for each in wanted if each not in seen]
    installed = {name for name, _ in seen if _is_installed(name)} - {DISTRIBUTION, "pip", "setuptools"}
    cuda = {name for name in installed if name.startswith(("nvidia-", "cuda-")) or name == "triton"}
    assert installed - cuda <= pinned, f"not in constraints.txt: {sorted(installed - cuda - pinned)}"


def _is_installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def test_every_package_with_shipped_data_has_a_licence_beside_it() -> None:
    folders = [folder for package in ("noiseflow", "recon") for folder in (ROOT / package / "data").iterdir()]
    folders = [folder for folder in folders if folder.is_dir() and folder.name != "__pycache__"]
    assert folders
    assert not [folder for folder in folders if not (folder / "LICENSE").is_file()]


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)], folder)
    return folder


def run(command: list[str], folder: Path, **environment: str) -> str:
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=folder, env=clean | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def test_wheel_is_small_whole_and_licensed(shipped: Path) -> None:
    (wheel,) = shipped.glob("*.whl")
    assert wheel.stat().st_size < 10e6
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = message_from_bytes(archive.read(next(n for n in names if n.endswith(".dist-info/METADATA"))))
    sources = {str(f.relative_to(ROOT)) for p in ("noiseflow", "recon", "calibration") for f in (ROOT / p).rglob("*")}
    wanted = {name for name in sources if (ROOT / name).is_file() and "__pycache__" not in name}
    assert wanted <= set(names), sorted(wanted - set(names))
    assert not [name for name in names if re.match(r"(tests|docs|build|benchmarks)/", name)]
    licences = {name.split("/licenses/")[1] for name in names if "/licenses/" in name}
    data = {str(f.relative_to(ROOT)) for p in ("noiseflow", "recon") for f in (ROOT / p / "data").rglob("LICENSE")}
    assert licences == data | {"LICENSE"}
    assert set(metadata.get_all("License-File") or []) == licences
    assert metadata["Requires-Python"] == ">=3.11"


def test_sdist_holds_the_sources_of_the_wheel(shipped: Path) -> None:
    (sdist,) = shipped.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "noiseflow/py.typed", "recon/napari/napari.yaml"} <= names


@pytest.mark.slow
def test_demo_of_the_installed_wheel_needs_no_checkout(shipped: Path, tmp_path: Path) -> None:
    """The dependencies are this environment's; noiseflow itself comes from the wheel alone."""
    (wheel,) = shipped.glob("*.whl")
    empty, work = tmp_path / "environment", tmp_path / "work"
    work.mkdir()
    run([sys.executable, "-m", "venv", str(empty)], work)
    binaries = empty / ("Scripts" if os.name == "nt" else "bin")
    python = str(binaries / "python")
    run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(wheel)], work)
    packages = Path(run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], work).strip())
    borrowed = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "borrowed.pth").write_text("\n".join(borrowed), encoding="utf-8")
    home = run([python, "-c", "import noiseflow, recon; print(noiseflow.__file__, recon.__file__)"], work)
    assert home.count(str(packages)) == 2
    run([str(binaries / "noiseflow"), "demo", "--out", "demo"], work, OMP_NUM_THREADS="1")
    assert "Verdict: doubtful; the converter" in (work / "demo" / "report.html").read_text(encoding="utf-8")
    assert list((work / "demo").rglob("*.mrc"))


def test_what_pip_installs_by_default_is_free_of_the_gpl() -> None:
    """The extra [formats] brings RosettaSciIO, GPL-3.0; nobody gets it without asking for it."""
    pending, seen = [DISTRIBUTION], set()
    while pending:
        name = pending.pop()
        if name in seen or not _is_installed(name):
            continue
        seen.add(name)
        for requirement in map(Requirement, importlib.metadata.requires(name) or []):
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                pending.append(canonicalize_name(requirement.name))
    assert {"torch", "numpy", "mrcfile"} <= seen
    assert not {name for name in seen if _is_gpl(name)}
    assert _is_gpl("rosettasciio")


def _is_gpl(package: str) -> bool:
    metadata = importlib.metadata.metadata(package)
    told = [metadata.get("License-Expression") or "", (metadata.get("License") or "")[:80]]
    told += [line for line in metadata.get_all("Classifier") or [] if line.startswith("License")]
    return any(re.search(r"(?<!L)GPL|(?<!Lesser )General Public", text) for text in told)


def test_supported_pythons_are_said_alike_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = {c.split(" :: ")[-1] for c in project["classifiers"] if re.search(r"Python :: 3\.\d+$", c)}
    assert versions == {"3.11"}
    assert "Python ≥ 3.11" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_no_hint_installs_the_other_project_that_has_our_import_name() -> None:
    """`pip install noiseflow` would install another project of the index; hints name our distribution or the checkout."""
    files = [file for name in ("noiseflow", "recon", "calibration", "docs") for file in (ROOT / name).rglob("*.*")]
    texts = [file for file in [*files, *ROOT.glob("*.md")] if file.suffix in {".py", ".md", ".ipynb", ".yaml"}]
    wrong = re.compile(r"pip install (-\S+ )*['\"]?noiseflow(?!-)")
    assert not [str(file.relative_to(ROOT)) for file in texts if wrong.search(file.read_text(encoding="utf-8"))]


def test_hints_outside_a_checkout_name_our_distribution(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(installation, "_CHECKOUT", tmp_path)
    assert installation.install_command("formats") == f"pip install '{DISTRIBUTION}[formats]'"


CONDA = {"torch": "pytorch", "opencv-contrib-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def test_the_conda_recipe_has_the_requirements_and_version_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {
        f"{CONDA.get(each.name, each.name.lower())} {each.specifier}"
        for each in map(Requirement, project["dependencies"])
    }
    recipe = (ROOT / "shipping" / "recipe.yaml").read_text(encoding="utf-8")
    listed = re.findall(r"^    - (.+)$", recipe.partition("  run:")[2].partition("\ntests:")[0], flags=re.MULTILINE)
    assert set(listed) == wanted | {f"python {project['requires-python']}"}
    assert f'version: "{project["version"]}"' in recipe


def test_a_release_changes_every_version(tmp_path: Path) -> None:
    release = runpy.run_path(str(ROOT / "shipping" / "release.py"))
    names = [*release["VERSIONS"], "CHANGELOG.md"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    old = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    release["write_versions"](tmp_path, "9.8.7rc1")
    texts = {name: (tmp_path / name).read_text(encoding="utf-8") for name in names}
    assert all("9.8.7rc1" in text for text in texts.values())
    assert not [name for name in release["VERSIONS"] if re.search(rf"version\W+{re.escape(old)}", texts[name])]
    assert tomllib.loads(texts["pyproject.toml"])["project"]["version"] == "9.8.7rc1"
    with pytest.raises(ValueError, match=r"1\.2\.3"):
        release["write_versions"](tmp_path, "next")
