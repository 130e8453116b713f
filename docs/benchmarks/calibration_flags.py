"""Sabotaged and unusual exposures: `python docs/benchmarks/calibration_flags.py [--seeds N] [--only WORD]`.

Every case of tests/calibration/sabotage.py is measured; a row says the truth, the gain reported, and the verdict. The rows are
printed as Markdown and stored in ``results/calibration_flags.json`` beside this file.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
# this folder holds a file of the package's name, which must not hide the package; the cases are those of the tests
sys.path = [path for path in sys.path if Path(path or ".").resolve() != HERE] + [str(HERE.parents[1])]
RESULTS = HERE / "results" / "calibration_flags.json"


def measured(name: str, seed: int) -> dict[str, Any]:
    """One case of one seed."""
    from calibration.exposures.frames import Burst, ExposurePair
    from calibration.pipeline import measure_exposures
    from tests.calibration.sabotage import CASES

    case = CASES[name](seed)
    options = dict(case.options)
    dark = options.pop("dark", None)
    started = time.process_time()
    row: dict[str, Any] = {"case": name, "seed": seed, "truth": case.gain, "clean": case.clean}
    try:
        exposures = Burst(case.short) if case.long is None else [ExposurePair(case.short, case.long, **options)]
        found = measure_exposures(exposures, dark=None if dark is None else Burst(dark, calibration=True))
    except ValueError as error:
        return row | {"verdict": "refused", "reasons": [str(error)], "gain": None}
    gain = None if found.figures is None else vars(found.figures.gain)
    reasons = [one.name for one in found.verdict.reasons]
    return row | {
        "verdict": found.verdict.grade,
        "reasons": reasons,
        "gain": gain,
        "seconds": time.process_time() - started,
    }


def line(row: dict[str, Any]) -> str:
    """A row of the Markdown table."""
    gain = row["gain"]
    value = "–" if gain is None else f"{gain['median']:.4g} ({gain['q05']:.4g} … {gain['q95']:.4g})"
    wrong = "" if gain is None else f"{100 * (gain['median'] / row['truth'] - 1):+.1f} %"
    return f"| {row['case']} | {row['truth']:g} | {value} | {wrong} | {row['verdict']} | {', '.join(row['reasons'])} |"


def main() -> None:
    from tests.calibration.sabotage import CASES

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="random scenes of each case")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    arguments = parser.parse_args()
    print("| case | true gain | gain reported (90 %) | error | verdict | reasons |\n|---|---|---|---|---|---|")
    rows = []
    for name in CASES:
        for seed in range(3, 3 + arguments.seeds) if arguments.only in name else ():
            rows.append(measured(name, seed))
            print(line(rows[-1]), flush=True)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    silent = [row for row in rows if row["verdict"] == "good" and abs(row["gain"]["median"] / row["truth"] - 1) > 0.02]
    print(f"\n{len(rows)} rows; {len(silent)} off by over 2 % without a flag: {[row['case'] for row in silent]}")


if __name__ == "__main__":
    main()
