"""The command `noiseflow doctor`: reports what is installed, what is missing, and whether it works on this machine."""

import importlib.util
import platform
import time
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions, requires
from pathlib import Path
from typing import Any

import typer

from noiseflow.commands.console import JsonOption, Output
from noiseflow.described import bytes_in_words
from noiseflow.installation import DISTRIBUTION, GROUPS, install_command, load_plugin, plugins, version_of
from noiseflow.resources import waiting

_LICENCES = {"formats": " (RosettaSciIO: GPL-3.0)", "bm3d": " (for non-commercial use only)"}


def doctor(json: JsonOption = False) -> None:
    """Check the installation: versions, devices, extras, and a self-test of a few seconds."""
    out = Output(json)
    required = _requirements()
    packages = {name: version_of(name) for name in required.pop("", [])}
    python = f"Python {platform.python_version()}, {platform.platform(terse=True)}"
    out.line(f"noiseflow {version_of(DISTRIBUTION)}, {python}\n")
    modules = {name: modules_of(name) for name in packages} | {name: [name] for name in OWN}
    places = {name: {str(folder_of(module) or "nowhere") for module in each} for name, each in modules.items()}
    folders = {name: ", ".join(sorted(each)) or "nowhere" for name, each in places.items()}
    packed = [(name, found or "missing", folders[name]) for name, found in packages.items()]
    out.table(("package", "version", "loaded from"), [*((name, "", folders[name]) for name in OWN), *packed])
    problems = [*(f"shadow: {line}" for line in shadows(list(packages))), *_broken_plugins()]
    for problem in problems:
        out.line(f"\nwarning: {problem}")
    devices = _devices()
    out.line(f"\ndevices: {'; '.join(devices)}")
    out.line(f"idle threads: {waiting()}; set this in your own programs too, before Python starts\n")
    extras: dict[str, Any] = {}
    for name in sorted(required.keys() - {"test", "docs", "benchmark"}, key=list(required).index):
        missing = [each for each in required[name] if version_of(each) is None]
        advice = f"missing {', '.join(missing)}; install with: {install_command(name)}" if missing else "installed"
        extras[name] = {"missing": missing, "advice": advice}
        out.line(f"extra [{name}]: {advice}{_LICENCES.get(name, '')}")
    tests = run_self_tests()
    out.line("")
    for name, result in tests.items():
        out.line(f"self-test {name}: {result['problem'] or 'ok'} ({result['seconds']:.1f} s)")
    healthy = all(packages.values()) and not problems and not any(result["problem"] for result in tests.values())
    out.result(
        {
            "healthy": healthy,
            "versions": {"noiseflow": version_of(DISTRIBUTION), "python": platform.python_version(), **packages},
            "folders": folders,
            "problems": problems,
            "devices": devices,
            "idle_threads": waiting(),
            "extras": extras,
            "self_tests": tests,
        }
    )
    if not healthy:
        raise typer.Exit(1)


def run_self_tests() -> dict[str, dict[str, Any]]:
    """Run the self-tests of all installed packages (entry points ``noiseflow.self_tests``).

    Returns:
        For each test, its problem (None if it passed) and its duration, s.
    """
    results = {}
    for name, point in sorted(plugins("noiseflow.self_tests").items()):
        started = time.perf_counter()
        try:
            problem = load_plugin(point)()
        except Exception as error:  # every failure is reported to the user
            problem = f"{type(error).__name__}: {error}"
        results[name] = {"problem": problem, "seconds": time.perf_counter() - started}
    return results


def check_noise_models() -> str | None:
    """Fit a signal-dependent Gaussian to noise of known strength and sample it. Return the problem, or None."""
    import torch

    import noiseflow

    generator = torch.Generator().manual_seed(0)
    signal = torch.linspace(10, 100, 5_000)
    observation = signal + signal.sqrt() * torch.randn(signal.shape, generator=generator)
    model = noiseflow.SignalDependentGaussian()
    noiseflow.fit(model, signal, observation, num_steps=60, generator=generator)
    sampled = model(signal).sample(generator=generator) - signal
    ratio = float(sampled.std() / (observation - signal).std())
    return None if 0.8 < ratio < 1.25 else f"the fitted model's noise is {ratio:.2f} times the true one"


def _broken_plugins() -> list[str]:
    problems = []
    for group in GROUPS:
        for point in plugins(group).values():
            try:
                load_plugin(point)
            except ImportError as error:
                problems.append(str(error))
    return problems


def _requirements() -> dict[str, list[str]]:
    """Extra ("" for the core) → names of the packages that it needs on this machine."""
    from packaging.requirements import Requirement

    found: dict[str, list[str]] = {}
    for line in requires(DISTRIBUTION) or []:
        requirement = Requirement(line)
        extra = line.partition("extra == ")[2].strip(" \"')")
        applies = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        if requirement.name != DISTRIBUTION and applies:
            found.setdefault(extra, []).append(requirement.name)
    return found


def _devices() -> list[str]:
    import torch

    found = [f"cpu ({torch.get_num_threads()} threads)"]
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        found.append(f"cuda:{index} ({properties.name}, {bytes_in_words(properties.total_memory)})")
    return found if len(found) > 1 else [*found, "no CUDA GPU"]


OWN = ("noiseflow", "calibration", "recon")


def folder_of(module: str) -> Path | None:
    """The folder that a top-level module would be imported from; None if it is not found."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    place = None if spec is None else next(iter(spec.submodule_search_locations or ()), spec.origin)
    return None if place is None else Path(place).parent


def modules_of(package: str) -> list[str]:
    """The public top-level modules of an installed package, in any spelling of its name."""
    from packaging.utils import canonicalize_name

    found = ((module, map(canonicalize_name, names)) for module, names in packages_distributions().items())
    return sorted(module for module, names in found if canonicalize_name(package) in names and module[0] != "_")


def shadows(packages: list[str]) -> list[str]:
    """One message for each module that is not loaded from its installed package.

    Args:
        packages: names of installed packages to check in addition to noiseflow, whose packages must be in one folder.
    """
    roots = dict.fromkeys(OWN, Path(__file__).parents[2])
    for package in packages:
        with suppress(PackageNotFoundError):
            roots |= dict.fromkeys(modules_of(package), Path(str(distribution(package).locate_file(""))))
    return [
        f"{module} is loaded from {folder}, not from {root}; rename that file or folder, or work in another folder"
        for module, root in roots.items()
        if (folder := folder_of(module)) is not None and not folder.resolve().is_relative_to(root.resolve())
    ]
