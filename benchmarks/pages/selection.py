"""Which model `noiseflow.select` takes for known noises, and what that costs: excess of its likelihood over the truth's.

    python -m benchmarks.pages.selection [--noise emccd ...] [--pixels 100000] [--seed 0] [--steps 500] [--again] [--page]

Each noise is one row of results/selection.json: held-out negative log-likelihood of every candidate above that of the true law
on the same pixels, and its standard error. selection.md shows the rows of default settings. The EMCCD is simulated electron by
electron (Poisson electrons, an exponential law for each in the register, read noise, rounding) and its exact masses are
computed by quadrature.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special

from benchmarks.pages import FOLDER, dots
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results
from noiseflow.fitting.selection import select

PIXELS, SEED = 100_000, 0  # of the page
OFFSET, READ_NOISE = 100.0, 8.0  # counts
LEVELS = 64
_PER_COUNT = 8  # nodes of the quadrature


def emccd(rate: NDArray[np.float64], gain: float, random: np.random.Generator) -> NDArray[np.float64]:
    """Counts of pixels with given mean electrons, (N,)."""
    electrons = random.poisson(rate)
    register = gain * random.standard_gamma(np.maximum(electrons, 1)) * (electrons > 0)
    return np.round(OFFSET + register + READ_NOISE * random.standard_normal(rate.size))


def emccd_log_mass(rate: float, gain: float, most: int) -> NDArray[np.float64]:
    """Exact log-mass of the counts −100 … `most` of a pixel with that many mean electrons."""
    step = 1 / _PER_COUNT
    register = (np.arange(int(most / step)) + 0.5) * step
    root = 2 * np.sqrt(rate * register / gain)
    density = np.exp(root - rate - register / gain) * np.sqrt(rate / (gain * register)) * special.ive(1, root)
    cells = density * step
    counts = np.arange(-100, most + 1)
    # the read noise and the rounding together: Φ over each cell of one count, for every place on the fine grid
    reach = int(8 * READ_NOISE)
    offsets = np.arange(-reach - 1, reach + 2)
    mass = np.exp(-rate) * _cell(counts - OFFSET)
    for phase in range(_PER_COUNT):
        shift = (phase + 0.5) * step
        coarse = cells[phase::_PER_COUNT]  # at whole counts + shift
        spread = np.convolve(coarse, _cell(offsets - shift))
        start = int(OFFSET) + int(offsets[0]) + 100
        end = min(start + spread.size, mass.size)
        mass[start:end] += spread[: end - start]
    return np.log(np.maximum(mass, 1e-300))


def _cell(difference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probability that read noise around 0 is rounded to each difference, counts."""
    high, low = (special.ndtr((difference + side) / READ_NOISE) for side in (0.5, -0.5))
    return np.asarray(high - low)


def emccd_data(
    gain: float, most_rate: float, count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Signals, counts, and the exact log-mass of each count; (N,) each. Rates go evenly from 1 % of the greatest to it."""
    random = np.random.default_rng(seed)
    rates = np.linspace(0.01, 1, LEVELS) * most_rate
    level = random.integers(LEVELS, size=count)
    observation = emccd(rates[level], gain, random)
    most = int(observation.max()) + 1
    table = np.stack([emccd_log_mass(rate, gain, most) for rate in rates])
    return OFFSET + gain * rates[level], observation, table[level, observation.astype(int) + 100]


def gamma_data(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Skewed noise without rounding: a gamma law of shape 4 whose width grows with the signal."""
    random = np.random.default_rng(seed)
    signal = random.random(count)
    scale, noise = 0.02 + 0.04 * signal, random.standard_gamma(4, count)
    return signal, signal + scale * (noise - 4), 3 * np.log(noise) - noise - special.gammaln(4) - np.log(scale)


NOISES = {
    "emccd": lambda count, seed: emccd_data(40.0, 20.0, count, seed),
    "emccd-dim": lambda count, seed: emccd_data(40.0, 3.0, count, seed),
    "gamma": gamma_data,
}


SHOWN = {
    "emccd": ("Up to 20 electrons per pixel", ""),
    "emccd-dim": (
        "Up to 3 electrons per pixel",
        ", where the pixels without an electron are separated from all others",
    ),
}
"""Noises of the page: their title, and what follows it."""


def measure(noise: str, pixels: int, seed: int, steps: int | None) -> dict[str, Any]:
    """One row: the candidates, and the one chosen."""
    signal, observation, log_mass = NOISES[noise](pixels, seed)
    judging = np.random.default_rng(seed + 1).random(signal.size) < 0.25
    started = time.process_time()
    apart = torch.from_numpy(judging)
    found = select(signal, observation, held_out=apart, num_steps=steps, seed=seed, refit=False)
    truth = -float(log_mass[judging].mean())
    candidates = [
        {
            "model": each.name,
            "excess": each.nll - truth,
            "behind": each.excess,
            "behind error": each.excess_error,
            "screened out": each.screened_out,
        }
        for each in found.candidates
    ]
    seconds = time.process_time() - started
    return {"chosen": found.chosen.name, "true NLL": truth, "seconds": seconds, "candidates": candidates}


def table(row: dict[str, Any]) -> str:
    """The candidates of a noise as Markdown; the chosen one is bold."""
    lines = ["| model | excess over the truth, nats per pixel | behind the best |", "|---|---|---|"]
    for each in row["candidates"]:
        name = f"**{each['model']}**" if each["model"] == row["chosen"] else each["model"]
        behind = f"{each['behind']:.4f} ± {each['behind error']:.4f}" if each["behind"] else "0"
        lines.append(f"| {name} | {each['excess']:.4f} | {behind} |")
    return "\n".join(lines)


def shown(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The rows of the page, by noise."""
    cells = {noise: content["cells"].get(f"{noise}/{PIXELS}/{SEED}") for noise in SHOWN}
    return {noise: row for noise, row in cells.items() if row}


def draw(content: dict[str, Any]) -> None:
    """Draw the excess of each model over the truth."""
    panels: list[dots.Panel] = []
    for noise, row in shown(content).items():
        ranked = sorted(row["candidates"], key=lambda each: float(each["excess"]))
        excess = {each["model"]: each["excess"] for each in ranked}
        chosen = {row["chosen"]: excess.pop(row["chosen"])}
        series = {"chosen": chosen, "other models": excess}
        panels.append((f"EMCCD, {SHOWN[noise][0].lower()}", "excess over the truth (nats per pixel)", series))
    dots.save(FOLDER / "selection.png", panels, columns=2, logarithmic=True)


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    rows = shown(content)
    tables = "\n\n".join(
        f"**{SHOWN[noise][0]}** (`{noise}`){SHOWN[noise][1]}:\n\n{table(rows[noise])}" for noise in rows
    )
    machines = [content["machines"][number] for number in sorted({row["machine"] for row in rows.values()})]
    return PAGE.format(tables=tables, measured=measured_on([{"cells": rows, "machines": machines}]))


PAGE = """\
# Which noise model is chosen

![Excess of each model over the truth for two noises, on a logarithmic axis](selection.png)

*Excess of the held-out negative log-likelihood of each model over that of the true law; further left is better.*

`noiseflow.select` takes the simplest model whose held-out likelihood is within one standard error of the best. This page
applies it to noises whose law is known exactly, and gives its loss to the truth in nats per pixel.

```sh
python -m benchmarks.pages.selection [--noise emccd emccd-dim gamma] [--pixels 100000] [--seed 0]
```

The noise is that of an EMCCD with gain 40 and 8 counts of read noise, simulated electron by electron; its exact masses are
computed by quadrature. Of 100 000 pixels, three quarters are fitted and one quarter judges. The chosen model is in bold
type.

{tables}

The excess over the truth has an uncertainty of about 0.0004, from 25 000 judging pixels. `ExcessNoise` contains the law of an
EMCCD, the others do not.

{measured}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--pixels", type=int, default=PIXELS)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--steps", type=int, help="of every model, in place of its own number")
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--page", action="store_true", help="write the page only")
    options = parser.parse_args()
    results = Results(FOLDER / "results" / "selection.json", "selection")
    for name in [] if options.page else options.noise:
        key = f"{name}/{options.pixels}/{options.seed}" + (f"/{options.steps} steps" if options.steps else "")
        if options.again:
            results.cells.pop(key, None)
        row = results.cell(key, lambda n=name: measure(n, options.pixels, options.seed, options.steps))  # type: ignore[misc]
        print(f"\n{key}\n{table(row)}", flush=True)
    draw(results.content)
    (FOLDER / "selection.md").write_text(page(results.content), encoding="utf-8")


if __name__ == "__main__":
    main()
