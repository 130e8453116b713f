"""Seconds and GB per 10⁶ pixels of likelihoods, gradients and draws; writes results/torch_cost.json and torch.md.

OMP_NUM_THREADS=2 python -m benchmarks.pages.torch_cost                        all rows, some ten minutes
OMP_NUM_THREADS=2 python -m benchmarks.pages.torch_cost --only "Gaussian"      one model; the rows of the others are kept
OMP_NUM_THREADS=2 python -m benchmarks.pages.torch_cost --quick                a few minutes
python -m benchmarks.pages.torch_cost --page                                   the page only, from the stored results
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from statistics import median
from typing import Any

import torch

import noiseflow as nf
from benchmarks.pages import FOLDER, dots
from benchmarks.provenance import machine, measured_on, origin

RESULTS = FOLDER / "results" / "torch_cost.json"


def camera(read_noise: float = 1.2) -> nf.Digitised:
    """A 16-bit camera; by default the guide's."""
    return nf.Digitised(nf.PoissonGaussian(2, 100, read_noise), 1, 0, 65535)


class TorchNormal(torch.nn.Module):
    """What torch itself needs for the simplest noise: the yardstick."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = torch.nn.Parameter(torch.tensor(-2.3))

    def forward(self, signal: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(signal, self.log_scale.exp())


class Zuko(torch.nn.Module):
    """zuko's neural spline flow of one number, conditioned on the signal."""

    def __init__(self) -> None:
        super().__init__()
        import zuko

        self.flow = zuko.flows.NSF(features=1, context=1, transforms=1, hidden_features=(32, 32))

    def forward(self, signal: torch.Tensor) -> Any:
        return self.flow(signal[..., None])


MODELS: dict[str, tuple[Callable[[], Any], float, float]] = {
    "torch Normal": (TorchNormal, 0.0, 1.0),
    "zuko NSF": (Zuko, 0.0, 1.0),
    "Gaussian": (nf.Gaussian, 0.0, 1.0),
    "spline flow": (nf.SplineFlow, 0.0, 1.0),
    "8-bit spline flow": (lambda: nf.Digitised(nf.SplineFlow(), 1 / 255, 0.0, 1.0), 0.0, 1.0),
    "mixture of 3": (nf.Mixture, 0.0, 1.0),
    "Poisson-Gaussian": (lambda: nf.PoissonGaussian(2, 100, 1.2), 100.0, 2000.0),
    "16-bit camera, read noise 0.2": (lambda: camera(0.2), 100.0, 2000.0),
    "16-bit camera, read noise 1.2": (camera, 100.0, 2000.0),
    "16-bit camera, read noise 5": (lambda: camera(5.0), 100.0, 2000.0),
    "16-bit camera, read noise 10": (lambda: camera(10.0), 100.0, 2000.0),
    "physics and flow": (lambda: nf.PhysicsFlow(detector=nf.PoissonGaussian(2, 100, 1.2)), 100.0, 2000.0),
}
TASKS = {
    "gradient": ("first", "again"),
    "no gradient": ("first", "again", "wider range"),
    "draws": ("first", "again"),
}
"""What one process does, and what it times on the way; its memory is that of the first."""
REPEATS = {"float32": 3, "float64": 1, "bfloat16": 1}


class Inputs:
    """Signals, evenly spread, and observations of them under the model: made once, and shared by all its processes."""

    def __init__(self, name: str, count: int) -> None:
        self.make, low, high = MODELS[name]
        self.signal = low + (high - low) * torch.rand(count, generator=torch.Generator().manual_seed(0))
        self.wider = self.signal + 0.2 * (self.signal - low)
        model = self.make()
        torch.manual_seed(0)
        # in pieces too small for a table, which would be there before the first task
        parts = [model(part).sample().detach().reshape(-1) for part in self.signal.split(2**14)]
        self.seen = torch.cat(parts)


def measure(inputs: Inputs, dtype: torch.dtype, task: str) -> dict[str, float]:
    """Seconds of each step of a task, and peak GB of the first above the inputs, both per 10⁶ pixels."""
    model, signal, wider = inputs.make(), inputs.signal.to(dtype), inputs.wider.to(dtype)
    seen = inputs.seen
    if not isinstance(model, nf.NoiseModelBase):  # other libraries compute in one number type throughout
        model, seen = model.to(dtype), seen.to(dtype)
    signal.requires_grad_(task == "gradient")
    torch.set_grad_enabled(task == "gradient")

    def likelihood(at: torch.Tensor) -> torch.Tensor:
        distribution = model(at)
        found: torch.Tensor = distribution.log_prob(seen[..., None] if distribution.event_shape else seen)
        return found

    does: dict[str, Callable[[str], Any]] = {
        "gradient": lambda step: likelihood(signal).sum().backward(),
        "no gradient": lambda step: likelihood(wider if step == "wider range" else signal),
        "draws": lambda step: model(signal).sample(),
    }
    found, scale = {}, 1e6 / signal.numel()
    for step in TASKS[task]:
        before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
        does[task](step)
        found[step] = (time.perf_counter() - started) * scale
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        found.setdefault("gigabytes", grown * scale / 2**20)
    return found


def _answer(out: Connection, threads: int, inputs: Inputs, dtype: str, task: str) -> None:
    torch.set_num_threads(threads)
    try:
        out.send(measure(inputs, getattr(torch, dtype), task))
    except (RuntimeError, NotImplementedError, ValueError) as error:  # a type that the model cannot compute in
        print(f"{task} in {dtype}: {error}", file=sys.stderr)


def in_own_process(threads: int, inputs: Inputs, dtype: str, task: str) -> dict[str, float] | None:
    """What `measure` finds in a fork of this process, which starts without its peak of memory; None where the task fails."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sender, threads, inputs, dtype, task))
    process.start()
    sender.close()
    try:
        found: dict[str, float] = receiver.recv()
    except EOFError:  # it ended without an answer
        return None
    finally:
        process.join()
    return found


def rows_of(name: str, count: int, threads: int, repeats: dict[str, int]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The cells of one model; none where its package is not installed."""
    try:
        inputs = Inputs(name, count)
    except ImportError:
        return
    for dtype, times in repeats.items():
        cell: dict[str, Any] = dict(origin())
        for task in TASKS:
            runs = [in_own_process(threads, inputs, dtype, task) for _ in range(times)]
            done = [run for run in runs if run is not None]
            cell[task] = {key: round(median(run[key] for run in done), 4) for key in done[0]} if done else None
        yield f"{name} | {dtype}", cell


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=MODELS)
    parser.add_argument("--quick", action="store_true", help="3·10⁵ pixels, float32 alone, single runs")
    parser.add_argument("--page", action="store_true", help="write the page only")
    given = parser.parse_args()
    if given.page:
        write_page(json.loads(RESULTS.read_text(encoding="utf-8")))
        return
    result: dict[str, Any] = {"cells": {}, "machines": [machine()], "quick": given.quick}
    count, repeats = (300_000, {"float32": 1}) if given.quick else (10**6, REPEATS)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a process that has used several threads cannot be forked
    for name in [given.only] if given.only else MODELS:
        for row, cell in rows_of(name, count, threads, repeats):
            result["cells"][row] = cell
            print(line_of(row, cell), flush=True)
    if given.only and not given.quick and RESULTS.exists():
        kept = json.loads(RESULTS.read_text(encoding="utf-8"))
        cells = kept["cells"] | result["cells"]
        order = {name: place for place, name in enumerate(MODELS)}
        result = kept | {"cells": dict(sorted(cells.items(), key=lambda cell: order[cell[0].rpartition(" | ")[0]]))}
    if not (given.only and given.quick):
        RESULTS.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        write_page(result)


def write_page(result: dict[str, Any]) -> None:
    """Write the page and its picture."""
    draw(result)
    (FOLDER / "torch.md").write_text(page_of(result), encoding="utf-8")


def draw(result: dict[str, Any]) -> None:
    """Draw the float32 rows: seconds of repeated calls, and memory of the first."""
    rows = {row.rpartition(" | ")[0]: cell for row, cell in result["cells"].items() if row.endswith(" | float32")}

    def column(key: str) -> dict[str, dict[str, float]]:
        return {task: {name: cell[task][key] for name, cell in rows.items() if cell[task]} for task in TASKS}

    panels = [
        ("Time, second call, float32", "seconds per 10⁶ pixels", column("again")),
        ("Memory, first call, float32", "peak GB per 10⁶ pixels, above the inputs", column("gigabytes")),
    ]
    dots.save(FOLDER / "torch.png", panels, columns=2, logarithmic=True, one_legend=True)


def line_of(row: str, cell: dict[str, Any]) -> str:
    """A row of the page's table."""
    columns = []
    for task, steps in TASKS.items():
        found = cell[task]
        columns += ["–" if found is None else f"{found[step]:.3f}" for step in steps]
        columns.append("–" if found is None else f"{found['gigabytes']:.2f}")
    return f"| {row} | " + " | ".join(columns) + " |"


def page_of(result: dict[str, Any]) -> str:
    """The results page."""
    table = "\n".join(line_of(row, cell) for row, cell in result["cells"].items())
    quick = " with `--quick`: 3·10⁵ pixels, float32 alone, single runs" if result["quick"] else ""
    return PAGE.format(table=table, quick=quick, measured=measured_on([result]))


PAGE = """\
# Speed and memory of likelihoods

![Seconds and gigabytes per million pixels of twelve models: gradient, no gradient, draws](torch.png)

*Time and memory of each model in float32; both axes are logarithmic, and further left is better.*

How much time and memory does a likelihood take inside a training loop? The table shows seconds, and peak gigabytes above the
inputs, per 10⁶ pixels, beside the normal distribution of torch and the neural spline flow of zuko.

| model | type | gradient: first (s) | again (s) | (GB) | no gradient: first (s) | again (s) | wider (s) | (GB) | draws: \
first (s) | again (s) | (GB) |
|---|---|---|---|---|---|---|---|---|---|---|---|
{table}

```
OMP_NUM_THREADS=2 python -m benchmarks.pages.torch_cost
```

wrote this page{quick}. `gradient` is one forward and one backward pass with respect to the signal and all parameters; the first
one in a process also loads parts of torch. Without a gradient, inputs of 2¹⁸ pixels and more are looked up in a table that the
first call builds; `wider` is a call with signals that reach 20 % further, which extends the table by the new rows. Memory is that
of the first call. Each task runs in a separate process: the median of three for float32, a single run for the other number
types. A dash marks a task that the model cannot do in that number type.

## What bounds the memory

- Likelihoods of more than 2¹⁸ pixels are evaluated in pieces. Where a gradient is asked for, the graph of a piece is made again
  in the backward pass, so that only one graph exists at a time.
- Shot noise with read noise, rounded or not, keeps its derivatives in place of a graph: 48 bytes per pixel at most.
- `ScanNoise` is the exception: pixels that share an offset are evaluated together, line by line of the whole image.

## What the tables guarantee

Each pixel's interpolation error is below 10⁻³ nats, estimated from second differences of the table. Pixels where it is not, and
pixels beyond the table's edges, are evaluated exactly. A table is found by a hash of the contents of the parameters, their
number type and device, so that it follows any change, however it was made.

{measured}
"""


if __name__ == "__main__":
    main()
