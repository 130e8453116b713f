"""Sabotaged and unusual exposures: `python -m benchmarks.pages.calibration_flags [--seeds N] [--only WORD] [--page]`.

Every case of tests/calibration/sabotage.py, every way of kept_ways.py, which is judged and never tuned on, and every
preset of calibration_presets.py where the package getframes is
installed, is measured; a row says the truth, the gain reported, and the verdict. The rows are stored in
``results/calibration_flags.json`` in docs/benchmarks, and calibration_flags.md and its picture are made from them.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from benchmarks.pages import FOLDER

RESULTS = FOLDER / "results" / "calibration_flags.json"
PAGE = FOLDER / "calibration_flags.md"
PICTURE = PAGE.with_suffix(".png")
COMMAND = "python -m benchmarks.pages.calibration_flags"
GOAL = 0.02
"""Relative error of the gain from which on a row must carry a flag."""
COSTLY = 0.03
"""Relative error of the gain from which on a kept way must be found."""
UNSPOILT = FOLDER / "results" / "calibration_unspoilt.json"
"""Rows of unspoilt exposures of other detectors and sizes, from ``--unspoilt``."""
SIDES = {
    "flats": (3, 8, 16, 64, 128, 512),
    "pair": (40, 48, 64, 96, 128, 192, 256, 384, 512),
    "burst": (32, 64, 96, 128, 192, 256),
}
"""Sides of the frames, pixels, of three sets each."""
Row = dict[str, Any]


def all_cases() -> dict[str, Any]:
    """Makers of the cases, by name."""
    from benchmarks.pages.calibration_presets import cases
    from tests.calibration.kept_ways import KEPT
    from tests.calibration.sabotage import CASES

    return CASES | cases() | KEPT


def measured(name: str, make: Any, seed: int) -> Row:
    """One case of one seed."""
    from benchmarks.provenance import machine, origin
    from calibration.exposures.frames import Burst, ExposurePair
    from calibration.pipeline import measure_exposures
    from tests.calibration.kept_ways import KEPT

    case = make(seed)
    options = dict(case.options)
    dark = options.pop("dark", None)
    started = time.process_time()
    row: Row = {
        "case": name,
        "seed": seed,
        "truth": case.gain,
        "clean": case.clean,
        "kept": name in KEPT,
        "line": None,
        "machine": machine(),
        **origin(),
    }
    try:
        exposures = Burst(case.short) if case.long is None else [ExposurePair(case.short, case.long, **options)]
        found = measure_exposures(exposures, dark=None if dark is None else Burst(dark, calibration=True))
    except ValueError as error:
        return row | {"verdict": "refused", "reasons": [str(error)], "gain": None}
    return row | {
        "verdict": found.verdict.grade,
        "reasons": [one.reason for one in found.verdict.findings],
        "gain": None if found.figures is None else vars(found.figures.gain),
        "line": None if found.detector is None else found.detector.line.gain,
        "seconds": time.process_time() - started,
    }


def unspoilt(kind: str, side: int, seed: int) -> Row:
    """Exposures of a random Poisson-Gaussian detector: a pair, a burst, or flats at five levels with darks."""
    import numpy as np

    from benchmarks.provenance import machine, origin
    from calibration.camera import calibrate_camera
    from calibration.exposures.frames import Burst, ExposurePair
    from calibration.pipeline import measure_exposures
    from tests.calibration.simulators import exposed, random_scene

    generator = np.random.default_rng([side, seed, len(kind)])
    gain, read = float(np.exp(generator.uniform(*np.log((0.3, 6.0))))), float(generator.uniform(1.0, 6.0))
    offset = 6 * gain * read + generator.uniform(20, 500)  # the converter clips no noise
    dose, ratio = generator.uniform(20, 300), generator.uniform(4, 40)

    def taken(electrons: Any) -> Any:
        return exposed(generator, electrons, gain=gain, offset=float(offset), read_noise=read)

    scene = random_scene(generator, side, mean=float(dose), contrast=float(generator.uniform(0.3, 0.9)))
    if kind == "flats":
        frames = 4000 // side if side < 64 else 4
        levels = [np.full((frames, side, side), times * dose) for times in (1.0, 2.0, 5.0, 10.0, 20.0)]
        flats = [Burst(taken(level), calibration=True) for level in levels]
        found = calibrate_camera(flats, [Burst(taken(0 * levels[0]), calibration=True)])
    elif kind == "burst":
        found = measure_exposures(Burst(np.stack([taken(scene) for _ in range(6)])))
    else:
        found = measure_exposures([ExposurePair(taken(scene), taken(ratio * scene))])
    return {
        "case": f"{kind} {side} {seed}",
        "truth": gain,
        "verdict": found.verdict.grade,
        "reasons": [one.reason for one in found.verdict.findings],
        "gain": None if found.figures is None else vars(found.figures.gain),
        "machine": machine(),
        **origin(),
    }


def of_unspoilt() -> str:
    """A paragraph on the unspoilt sets."""
    if not UNSPOILT.exists():
        return ""
    rows: list[Row] = json.loads(UNSPOILT.read_text(encoding="utf-8"))
    alarms = [
        f"{row['case']} ({row['verdict']}: {', '.join(row['reasons'])})" for row in rows if row["verdict"] != "good"
    ]
    held = sum(contains(row) for row in rows if row["gain"])
    said = f"{len(alarms)} carr{'ies' if len(alarms) == 1 else 'y'} a flag" + ": " * bool(alarms) + "; ".join(alarms)
    return (
        f"**Unspoilt sets.** Of {len(rows)} sets of random detectors (pairs of 40² to 512², bursts of 32² to 256², flats and "
        f"darks of 3² to 512² pixels), {said}; {held} of the 90 % intervals contain the gain.\n\n"
    )


def error_of(row: Row) -> float:
    """Relative error of the gain; 0 where none is reported."""
    return 0.0 if row["gain"] is None else float(row["gain"]["median"] / row["truth"] - 1)


def silent(rows: list[Row]) -> list[Row]:
    """Rows that are wrong without a flag: off by more than `GOAL`, and the interval does not contain the truth."""
    return [row for row in rows if row["verdict"] == "good" and abs(error_of(row)) > GOAL and not contains(row)]


def contains(row: Row) -> bool:
    """Whether the interval contains the truth."""
    return bool(row["gain"]["q05"] <= row["truth"] <= row["gain"]["q95"])


def on_kept(rows: list[Row]) -> str:
    """A paragraph on the ways that were never tuned on."""
    kept = [row for row in rows if row.get("kept")]
    costly = [row for row in kept if abs(error_of(row)) > COSTLY]
    flagged = [row for row in costly if row["verdict"] != "good"]
    named = ", ".join(f"{row['case']} ({error_of(row):+.0%}, {', '.join(row['reasons'])})" for row in flagged)
    within = ", ".join(row["case"] for row in costly if row["verdict"] == "good" and contains(row)) or "none"
    return (
        f"**Kept ways.** {len(kept)} ways were written after the checks and their tolerances. {len(costly)} of them change the "
        f"gain by more than {COSTLY:.0%}; {len(flagged)} of these are flagged: {named}. Not flagged, but the interval contains "
        f"the truth: {within}.\n\n"
    )


def false_alarms(rows: list[Row]) -> list[Row]:
    """Clean rows with a flag other than that the interval is wide, which is no alarm but the truth."""
    return [row for row in rows if row["clean"] and set(row["reasons"]) - {"gain uncertain"}]


def line(row: Row) -> str:
    """A row of the Markdown table."""
    gain = row["gain"]
    value = "–" if gain is None else f"{gain['median']:.4g} ({gain['q05']:.4g} … {gain['q95']:.4g})"
    wrong = "" if gain is None else f"{error_of(row):+.1%}"
    plain = "–" if row["line"] is None else f"{row['line']:.4g} ({row['line'] / row['truth'] - 1:+.1%})"
    name = row["case"] + (" (clean)" if row["clean"] and "clean" not in row["case"] else "")
    return f"| {name} | {row['truth']:.4g} | {value} | {wrong} | {row['verdict']} | {', '.join(row['reasons'])} | {plain} |"


def _named(rows: list[Row]) -> str:
    return f"Without a flag: {', '.join(row['case'] for row in rows)}. " if rows else ""


def page(rows: list[Row]) -> str:
    """The page as Markdown."""
    from benchmarks.provenance import measured_on

    wrong, alarms = silent(rows), false_alarms(rows)
    text = (
        "# Calibration: unusual exposures, and whether they are flagged\n\n"
        f"![Error of the gain in percent, case by case: flagged and not]({PICTURE.name})\n\n"
        f"**Rows whose gain is wrong by more than 2 % and outside its interval, without a flag: {len(wrong)} of {len(rows)}; "
        f"clean rows with a flag: {len(alarms)} of {sum(row['clean'] for row in rows)}.**\n\n"
        "The gain must be within 2 % of the truth, or carry a flag (doubtful, bad, refused), or have an interval that contains "
        f"the truth; clean exposures must carry no flag. {_named(wrong)}A 90 % interval misses the truth once in ten scenes.\n\n"
        f"{on_kept(rows)}{of_unspoilt()}"
        "- **Exposures**: pairs of 256² pixels, gain 2 counts per electron, offset 100 counts, read noise 3 e⁻, exposure ratio "
        "16 (not given), unless the case states otherwise.\n"
        "- **Cases called `getframes`**: cameras of that independent simulator (512² pixels), at the gain of its data sheet, "
        "times the excess-noise factor if the camera multiplies electrons.\n"
        "- **Photon-transfer line**: the slope of variance against signal of the same pixels, after the same corrections, but "
        "without that for correlated pixels.\n"
        "- **Not in the table**: a long exposure saturated in one corner carries no flag. A test measures six scenes: five "
        "intervals must contain the truth, and all medians are within 4 %.\n\n"
        f"Written by `{COMMAND}` from `results/calibration_flags.json`.\n\n"
    )
    head = "| case | true gain | gain reported (90 %) | error | verdict | reasons | photon-transfer line |\n"
    cells = {str(index): row for index, row in enumerate(rows)}
    machines = list({json.dumps(row.get("machine")): row.get("machine") for row in rows}.values())
    table = head + "|---|---|---|---|---|---|---|\n" + "\n".join(map(line, rows))
    return f"{text}{table}\n\n{measured_on([{'cells': cells, 'machines': machines}])}\n"


def draw(rows: list[Row]) -> None:
    """The picture of the page: errors of the gain, largest last."""
    from benchmarks.pages import dots

    errors: dict[str, dict[str, float]] = {"no flag": {}, "flagged": {}}
    for row in sorted((row for row in rows if row["gain"] is not None), key=lambda row: abs(error_of(row))):
        errors["no flag" if row["verdict"] == "good" else "flagged"][row["case"]] = 100 * error_of(row)
    dots.save(
        PICTURE, [("Gain reported against the truth", "error (%)", errors)], columns=1, width=8.0, straight=100 * GOAL
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="random scenes of each case")
    parser.add_argument("--only", default="", help="cases whose name holds this; the others keep their rows")
    parser.add_argument("--page", action="store_true", help="write the page only")
    parser.add_argument("--unspoilt", action="store_true", help="measure the unspoilt sets, then write the page")
    arguments = parser.parse_args()
    if arguments.unspoilt:
        kinds = [(kind, side, seed) for kind, sides in SIDES.items() for side in sides for seed in range(3)]
        sound: list[Row] = []
        for one in kinds:
            sound.append(unspoilt(*one))
            UNSPOILT.write_text(json.dumps(sound, indent=1) + "\n", encoding="utf-8")
    rows: list[Row] = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []
    makers = {} if arguments.page or arguments.unspoilt else all_cases()
    if makers and not any(name.startswith("getframes") for name in makers):
        print("getframes is not installed (pip install getframes): its presets keep their rows")
    for name in (name for name in makers if arguments.only in name):
        new = [measured(name, makers[name], seed) for seed in range(3, 3 + arguments.seeds)]
        known = [index for index, row in enumerate(rows) if row["case"] == name]
        at = known[0] if known else len(rows)
        rows = [*rows[:at], *new, *(row for row in rows[at:] if row["case"] != name)]
        print("\n".join(map(line, new)), flush=True)
        RESULTS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    draw(rows)
    PAGE.write_text(page(rows), encoding="utf-8")
    print(f"\noff by over 2 % without a flag: {[row['case'] for row in silent(rows)]}")
    print(f"false alarms: {[row['case'] for row in false_alarms(rows)]}")


if __name__ == "__main__":
    main()
