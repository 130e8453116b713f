"""Noise models against known truths and rivals, and their speed.

    python -m benchmarks.pages.noise_models                                # everything below, in this order
    python -m benchmarks.pages.noise_models accuracy --noise gamma --model SplineFlow      # one row
    python -m benchmarks.pages.noise_models accuracy --resume              # the rows that are missing
    python -m benchmarks.pages.noise_models speed [--device cuda]          # ratios in one run; under 4 minutes on 2 cores
    python -m benchmarks.pages.noise_models search                         # the rivals' best settings
    python -m benchmarks.pages.noise_models exposures --data DIR           # real and simulated exposure pairs
    python -m benchmarks.pages.noise_models page                           # noise_models.md and its figure, from the JSON

Each row is saved when it is done, in results/noise_models.json in docs/benchmarks; `page` draws what is there. zuko and
normflows come with the extra: python -m pip install '.[benchmark]' in the checkout.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import FOLDER, noise_page
from benchmarks.pages.noise_accuracy import MODELS, NOISES, measure, search
from benchmarks.pages.noise_exposures import exposures
from benchmarks.pages.noise_speed import speed
from benchmarks.provenance import origin
from noiseflow.commands.console import Output, choose_device
from noiseflow.io import atomic_path

RESULTS = FOLDER / "results" / "noise_models.json"
PARTS = ("all", "accuracy", "speed", "search", "exposures", "page")
SIZE, STEPS, SEED = 256, 500, 0
PACKAGES = ("noiseflow", "torch", "numpy", "zuko", "normflows")


class Results:
    """The JSON file, written whole after every row.

    Args:
        path: where it is; None keeps the rows in memory.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.content: dict[str, Any] = json.loads(path.read_text()) if path and path.exists() else {}

    def find(self, section: str, **key: Any) -> dict[str, Any] | None:
        """The row of a section with these values."""
        rows = self.content.get(section, [])
        return next((row for row in rows if all(row.get(name) == value for name, value in key.items())), None)

    def put(self, section: str, row: dict[str, Any], *keys: str) -> None:
        """Add a row, in place of the one that has the same values under `keys`."""
        rows = self.content.setdefault(section, [])
        old = self.find(section, **{key: row[key] for key in keys})
        row = row | {"machine": machine()}
        if old is None:
            rows.append(row)
        else:
            rows[rows.index(old)] = row
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(self.path) as partial:
                partial.write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")


def machine() -> str:
    """Processor, threads and versions in one line."""
    cpu = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    versions = [f"Python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            versions.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return f"{cpu}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads; {', '.join(versions)}"


def accuracy(results: Results, options: argparse.Namespace, output: Output) -> None:
    """Fit and judge every chosen model on every chosen noise; one line each."""
    settings = {"size": options.size, "num_steps": options.steps, "seed": options.seed}
    torch.set_num_threads(1)
    output.line(f"{'noise':22}{'model':28}{'KL':>9}{'± s.e.':>9}{'NLL gap':>9}{'JSD/floor':>11}{'fit (s)':>9}")
    for noise in options.noise or NOISES:
        for model in options.model or MODELS:
            if options.resume and results.find("accuracy", noise=noise, model=model, **settings):
                continue
            row = measure(noise, model, **settings) | origin()
            results.put("accuracy", row, "noise", "model")
            output.line(
                f"{noise:22}{row['label']:28}{row['kl']:9.4f}{row['kl_error']:9.4f}{row['nll_gap']:9.4f}"
                f"{row['jsd'] / row['jsd_floor']:11.2f}{row['seconds']:9.1f}"
            )


def main() -> None:
    """Run the chosen parts and save their rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", default="all", choices=PARTS)
    parser.add_argument("--noise", action="append", choices=NOISES, metavar="NAME", help=", ".join(NOISES))
    parser.add_argument("--model", action="append", choices=MODELS, metavar="NAME", help=", ".join(MODELS))
    parser.add_argument("--resume", action="store_true", help="leave out the rows that are there already")
    parser.add_argument("--size", type=int, default=SIZE, choices=(64, 128, 256, 512), help="side of the image")
    parser.add_argument("--steps", type=int, default=STEPS, help="optimisation steps of our models")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--device", default="cpu", help="of the speed rows: cpu or cuda")
    parser.add_argument("--data", type=Path, help="folder of the real exposures, exposures_miro")
    parser.add_argument("--out", type=Path, help="JSON file; by default the one in docs/benchmarks")
    options = parser.parse_args()
    output = Output(False)
    usual = (options.size, options.steps, options.seed) == (SIZE, STEPS, SEED)
    results = Results(options.out or (RESULTS if usual else None))
    chosen = PARTS[1:] if options.part == "all" else (options.part,)
    if options.data is not None and options.part == "all":
        chosen = ("exposures",)
    if "accuracy" in chosen:
        accuracy(results, options, output)
    if "speed" in chosen:
        for row in speed(choose_device(options.device), output):
            results.put("speed", row, "model", "what", "device")
    if "search" in chosen:
        for row in search(output):
            results.put("search", row, "model", "setting")
    if "exposures" in chosen:
        for row in exposures(options.data, output):
            results.put("exposures", row, "data", "model")
    if "page" in chosen:
        noise_page.write(results.content)
    if results.path is None:
        output.line("not saved: other than the usual size, steps or seed; name a file with --out to keep the rows")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"noise_models.py: {error}")
