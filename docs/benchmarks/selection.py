"""Which model `noiseflow.select` takes for known noises, and what that costs: excess of its likelihood over the truth's.

    python docs/benchmarks/selection.py [--noise emccd ...] [--pixels 100000] [--seed 0] [--steps 500]

Prints a table for each noise: held-out negative log-likelihood of every candidate above that of the true law on the same pixels,
its standard error, and process time. The EMCCD is simulated electron by electron (Poisson electrons, an exponential law for
each in the register, read noise, rounding) and its exact masses are computed by quadrature.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special

from noiseflow.fitting.selection import select

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", nargs="+", choices=NOISES, default=list(NOISES))
    parser.add_argument("--pixels", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="of every model, in place of its own number")
    options = parser.parse_args()
    for name in options.noise:
        signal, observation, log_mass = NOISES[name](options.pixels, options.seed)
        judging = np.random.default_rng(options.seed + 1).random(signal.size) < 0.25
        started = time.process_time()
        apart = torch.from_numpy(judging)
        found = select(signal, observation, held_out=apart, num_steps=options.steps, seed=options.seed, refit=False)
        truth = -float(log_mass[judging].mean())
        print(f"\n{name}: true NLL {truth:.4f} nats per pixel, {time.process_time() - started:.0f} s of process time")
        print("| model | excess over the truth | behind the best | screened out |\n|---|---|---|---|")
        for each in found.candidates:
            label = f"**{each.name}**" if each.name == found.chosen.name else each.name
            behind = f"{each.excess:.4f} ± {each.excess_error:.4f}"
            print(f"| {label} | {each.nll - truth:.4f} | {behind} | {'yes' if each.screened_out else ''} |", flush=True)


if __name__ == "__main__":
    main()
