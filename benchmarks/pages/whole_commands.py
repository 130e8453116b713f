"""Whole commands on a machine that has other work, and what their time consists of.

    python -m benchmarks.pages.whole_commands beside [--only WORD]   # each command alone and beside two busy processes, in turn
    python -m benchmarks.pages.whole_commands parts [--only WORD]    # processor time by part, of commands on one thread
    python -m benchmarks.pages.whole_commands page                   # whole_commands.md from the JSON

Wants a machine without other work. Rows are kept in results/whole_commands.json and measured again when asked for.
"""

from __future__ import annotations

import argparse
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results

RESULTS, PAGE = FOLDER / "results" / "whole_commands.json", FOLDER / "whole_commands.md"
GOAL, SHARE = 2.5, 0.1  # times the seconds alone; of the processor time, for a part that is no fit
_TURNS = 3
_OTHERS = 2
COMMANDS: dict[str, tuple[str, ...]] = {
    "simulate 64³": ("simulate", "OUT", "--phantom", "shells", "--size", "64", "--noise", "clipped"),
    "joint 64³": ("reconstruct", "SERIES 64", "-o", "OUT.mrc"),
    "joint 64³, report": ("reconstruct", "SERIES 64", "-o", "OUT.mrc", "--report", "OUT"),
    "joint 96³": ("reconstruct", "SERIES 96", "-o", "OUT.mrc"),
    "l2 64³": ("reconstruct", "SERIES 64", "-o", "OUT.mrc", "--method", "l2"),
    "sirt 64³": ("reconstruct", "SERIES 64", "-o", "OUT.mrc", "--method", "sirt"),
    "calibrate 256²": ("calibrate", "PAIR", "-o", "OUT.safetensors"),
}
"""Name, and words of the command: SERIES and a size stand for a series, PAIR for two exposures, OUT for a new output."""
PARTS = {
    "loading modules": ("<frozen importlib._bootstrap>", "_find_and_load"),
    "tables, coarse start": ("joint/coarse_start.py", "start_of"),
    "choices": ("joint/run.py", "choose"),
    "fit of the whole": ("joint/run.py", "fit_whole"),
    "verdict": ("verdict/judge.py", "judge"),
    "report": ("report/page.py", "reconstruction_report"),
}
"""Parts of `reconstruct`: end of the file's name, and the function whose time counts."""


def _noiseflow(*words: str) -> list[str]:
    return [sys.executable, "-m", "noiseflow", *words]


def _prepared(folder: Path) -> dict[str, list[str]]:
    """Input files by the word that stands for them."""
    from noiseflow.io import write
    from tests.calibration.simulators import RATIO, exposed, random_scene

    found: dict[str, list[str]] = {}
    for size in ("64", "96"):
        out = str(folder / f"series{size}")
        words = ("simulate", out, "--phantom", "shells", "--size", size, "--noise", "clipped", "--tilts=-59.5:58:1.5")
        subprocess.run(_noiseflow(*words), check=True, capture_output=True)
        found[f"SERIES {size}"] = [f"{out}/tilts.mrc"]
    generator = np.random.default_rng(0)
    scene = random_scene(generator, 256)
    found["PAIR"] = [str(folder / "short.tif"), str(folder / "long.tif")]
    for path, times in zip(found["PAIR"], (1, RATIO), strict=True):
        write(Path(path), exposed(generator, times * scene).astype(np.uint16))
    return found


def _words(name: str, inputs: dict[str, list[str]], out: Path) -> list[str]:
    words: list[str] = []
    for word in COMMANDS[name]:
        words += inputs.get(word) or [word.replace("OUT", str(out))]
    return words


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """So many other processes that compute without end."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: sum(range(10**6))"]) for _ in range(count)]
    try:
        yield
    finally:
        for each in others:
            each.kill()
            each.wait()


def beside(name: str, inputs: dict[str, list[str]], folder: Path) -> dict[str, Any]:
    """Median seconds of a command alone, beside busy processes, and alone on one thread, in turn."""
    usual = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    runs = {"alone": (0, usual), "beside": (_OTHERS, usual), "one thread": (0, usual | {"OMP_NUM_THREADS": "1"})}
    seconds: dict[str, list[float]] = {run: [] for run in runs}
    for _ in range(_TURNS):
        for run, (count, environment) in runs.items():
            words = _words(name, inputs, folder / f"out-{len(list(folder.iterdir()))}")
            with _busy(count):
                started = time.perf_counter()
                subprocess.run(_noiseflow(*words), check=True, capture_output=True, env=environment)
                seconds[run].append(time.perf_counter() - started)
    medians = {run: median(found) for run, found in seconds.items()}
    return {"name": name} | medians | {"ratio": medians["beside"] / medians["alone"]}


def parts(name: str, inputs: dict[str, list[str]], folder: Path) -> dict[str, Any]:
    """Processor seconds of a command, and the share of each part by Python's profiler, which slows small calls."""
    profile = folder / "profile"
    words = _words(name, inputs, folder / f"parts-{len(list(folder.iterdir()))}")
    command = [sys.executable, "-m", "cProfile", "-o", str(profile), "-m", "noiseflow", *words]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    stats = pstats.Stats(str(profile))
    whole = stats.total_tt  # type: ignore[attr-defined]
    shares = dict.fromkeys(PARTS, 0.0)
    for (file, _, function), (*_, cumulative, _) in stats.stats.items():  # type: ignore[attr-defined]
        for part, (end, called) in PARTS.items():
            if file.endswith(end) and function == called:
                shares[part] += cumulative / whole
    return {"name": name, "seconds": whole, "shares": shares | {"the rest": 1 - sum(shares.values())}}


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells = content["cells"].values()
    timed = [cell for cell in cells if "ratio" in cell]
    shared = [cell for cell in cells if "shares" in cell]
    lines = [
        "# Whole commands\n",
        "## Beside other work\n",
        f"Median seconds of {_TURNS} runs, alone and beside {_OTHERS} processes that compute without end, in turn, on the cores "
        f"of the machine below. The goal is at most {GOAL} times the time alone. "
        "`python -m benchmarks.pages.whole_commands beside` measures them.\n",
        "| command | alone (s) | beside (s) | ratio | alone, one thread (s) |\n|---|---|---|---|---|",
        *(
            f"| {c['name']} | {c['alone']:.1f} | {c['beside']:.1f} | {c['ratio']:.2f} | {c['one thread']:.1f} |"
            for c in timed
        ),
        "\n## What the time consists of\n",
        "Shares of the time of a command on one thread, by Python's profiler: "
        f"`python -m benchmarks.pages.whole_commands parts`. The goal is at most {SHARE:.0%} for every part that is no fit.\n",
        f"| command | seconds | {' | '.join([*PARTS, 'the rest'])} |\n|{'---|' * (len(PARTS) + 3)}",
        *(
            f"| {c['name']} | {c['seconds']:.1f} | {' | '.join(f'{share:.0%}' for share in c['shares'].values())} |"
            for c in shared
        ),
    ]
    return "\n".join(lines) + f"\n\n{measured_on([content])}\n"


def main() -> None:
    """Measure the chosen rows, or draw the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("beside", "parts", "page"))
    parser.add_argument("--only", default="", help="commands whose name holds this")
    options = parser.parse_args()
    results = Results(RESULTS, "whole commands")
    if options.part != "page":
        measure = {"beside": beside, "parts": parts}[options.part]
        with tempfile.TemporaryDirectory() as folder:
            inputs = _prepared(Path(folder))
            for name in COMMANDS:
                if options.only in name and (options.part == "beside" or COMMANDS[name][0] == "reconstruct"):
                    results.cells.pop(key := f"{options.part}/{name}", None)
                    print(results.cell(key, partial(measure, name, inputs, Path(folder))), flush=True)
    PAGE.write_text(page(results.content), encoding="utf-8")


if __name__ == "__main__":
    main()
