"""How long the library keeps a user waiting before it does anything: `python -m benchmarks.pages.start_up [--page]`.

Prints the time of ``import noiseflow`` (alone, and with every public name loaded) over that of ``import torch``, and the
seconds of ``noiseflow -h``; writes them to results/start_up.json and start_up.md.
Each is the median processor time of repeated fresh processes, taken in turns.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
from statistics import median
from typing import Any

from benchmarks.pages import FOLDER, dots
from benchmarks.provenance import machine, measured_on, origin

RESULTS = FOLDER / "results" / "start_up.json"
GOALS = {"import noiseflow": 1.3, "all of noiseflow": 1.3}  # times `import torch`
HELP_GOAL = 0.5  # s
COMMANDS = {
    "python": [sys.executable, "-c", "pass"],
    "import torch": [sys.executable, "-c", "import torch"],
    "import noiseflow": [sys.executable, "-c", "import noiseflow"],
    "all of noiseflow": [sys.executable, "-c", "import noiseflow; [getattr(noiseflow, n) for n in noiseflow.__all__]"],
    "noiseflow -h": [sys.executable, "-m", "noiseflow", "-h"],
}


def measure(repeats: int) -> dict[str, float]:
    """Median processor seconds of each command."""
    seconds: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for turn in range(repeats + 1):
        for name, command in COMMANDS.items():
            start = _of_children()
            subprocess.run(command, check=True, capture_output=True)
            if turn:  # the first turn only brings the files into memory
                seconds[name].append(_of_children() - start)
    return {name: median(times) for name, times in seconds.items()}


def _of_children() -> float:
    """Processor seconds of all processes that were started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def results_of(repeats: int) -> dict[str, Any]:
    """The results, with their origin."""
    seconds = measure(repeats)
    torch = seconds["import torch"]
    return {
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "machine": machine(),
        **origin(),
        "repeats": repeats,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "over import torch": {
            name: round(seconds[name] / torch, 3) for name in ("import noiseflow", "all of noiseflow")
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--page", action="store_true", help="write the page only")
    arguments = parser.parse_args()
    if not arguments.page:
        RESULTS.write_text(json.dumps(results_of(arguments.repeats), indent=1) + "\n", encoding="utf-8")
    result = json.loads(RESULTS.read_text(encoding="utf-8"))
    draw(result)
    (FOLDER / "start_up.md").write_text(page_of(result), encoding="utf-8")
    print(json.dumps(result, indent=1))


def draw(result: dict[str, Any]) -> None:
    """Draw the seconds of each command and its goal."""
    seconds = result["seconds"]
    goals = {name: times * seconds["import torch"] for name, times in GOALS.items()} | {"noiseflow -h": HELP_GOAL}
    panel = ("Fresh processes", "processor time (s)", {"median": seconds, "goal": goals})
    dots.save(FOLDER / "start_up.png", [panel], columns=1)


def page_of(result: dict[str, Any]) -> str:
    """The results page."""
    seconds = result["seconds"]
    torch = seconds["import torch"]
    rows = "".join(f"| `{name}` | {value:.2f} | {value / torch:.2f} |\n" for name, value in seconds.items())
    return f"""# Starting

![Seconds of each command, and the goals](start_up.png)

*Median processor time of a fresh process for each command, and its goal: left of the square is within the goal.*

`python -m benchmarks.pages.start_up` wrote this page: medians of the processor time of {result["repeats"]}
fresh processes each, taken in turns.
System: {result["system"]}.
The goals are `import noiseflow` below 1.3 times `import torch`, and `noiseflow -h` below 0.5 s.

| command | processor s | over `import torch` |
|---|---|---|
{rows}
`all of noiseflow` loads every public name; `import noiseflow` alone loads each when it is first used, and torch with it.

{measured_on([{"cells": {"medians": result}, "machines": [result["machine"]]}])}
"""


if __name__ == "__main__":
    main()
