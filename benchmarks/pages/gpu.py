"""The joint fit and its projector on a GPU beside the processor cores of the same machine, and how near memory they are.

    python -m benchmarks.pages.gpu run [--only joint] [--skip "512"] [--out FILE]   # rows that are there are kept
    python -m benchmarks.pages.gpu page                                             # gpu.md from the JSON

A row is saved when it is done, in results/gpu.json in docs/benchmarks. Noise models: python -m benchmarks.pages.noise_models
speed --device cuda.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results, in_turn, make_scene
from noiseflow import Mixture, PoissonGaussian, SplineFlow
from noiseflow.commands.console import Output
from recon.methods import reconstruct
from recon.metrics.metrics import compare
from recon.projection.projector import SliceProjector

RESULTS = FOLDER / "results" / "gpu.json"
_TILTS = "-59.5:58:1.5"
_GPU = torch.device("cuda")
_PIXELS = 500_000
_THREADS = (1, 2, 4, 8)
Row = dict[str, Any]


def copy() -> Row:
    """Memory bandwidth of the GPU: a gigabyte is read and written."""
    given = torch.rand(2**28, device=_GPU)
    found = torch.empty_like(given)
    seconds = _seconds(lambda: found.copy_(given), _GPU)
    return {"GB/s": 2e-9 * given.nbytes / seconds}


def projector(size: int) -> Row:
    """One projection and one back-projection of a cube at 79 tilts, and the memory that they must at least move.

    The least is the matrix, read once, and the volume and the images, each read or written once.
    """
    row: Row = {}
    for device in (_GPU, torch.device("cpu")):
        A = SliceProjector(tilt_angles=np.arange(-59.5, 58, 1.5), depth=size, width=size, device=device)
        volume = torch.rand(size * size, size, device=device)
        rays = A.project(volume)
        for name, run in (("forward", partial(A.project, volume)), ("adjoint", partial(A.backproject, rays))):
            row[f"{name}, {device.type}"] = _seconds(run, device)
        matrix = sum(each.values().nbytes + each.col_indices().nbytes for each in A.matrix.panels)
        row[f"least GB, {device.type}"] = 1e-9 * (matrix + volume.nbytes + rays.nbytes)
    return row


def noise(make: Callable[[], nn.Module]) -> Row:
    """The log-likelihood of pixels and a sample of them, under a model that is not fitted."""
    row: Row = {"pixels": _PIXELS}
    for device in (_GPU, torch.device("cpu")):
        model, signal = make().to(device), torch.rand(_PIXELS, device=device)
        with torch.no_grad():
            observation = model(signal).sample()
            likelihood = _seconds(partial(_log_prob, model, signal, observation), device, repeats=1)
            row |= {f"log_prob, {device.type}": likelihood}
            row |= {f"sample, {device.type}": _seconds(partial(_sample, model, signal), device, repeats=1)}
    return row


def _log_prob(model: nn.Module, signal: Tensor, observation: Tensor) -> None:
    model(signal).log_prob(observation)


def _sample(model: nn.Module, signal: Tensor) -> None:
    model(signal).sample()


def joint(size: int, method: str = "joint", on_cpu: bool = True, **options: Any) -> Row:
    """A reconstruction of shells with clipped noise and 79 tilts, everything chosen; the GPU is warmed up by a small one."""
    scene = make_scene(size, tilts=_TILTS)
    reconstruct(make_scene(32, tilts=_TILTS).noisy, method=method, device=_GPU, **options)
    row: Row = {"scene": scene.name}
    for device in (_GPU, torch.device("cpu"))[: 1 + on_cpu]:
        torch.cuda.reset_peak_memory_stats()
        ((seconds, found),) = in_turn(
            [partial(reconstruct, scene.noisy, method=method, device=device, **options)], repeats=1
        )
        row |= {
            f"seconds, {device.type}": seconds,
            f"volume PSNR (dB), {device.type}": compare(found.volume.attenuation, scene.truth).psnr,
        }
        if device == _GPU:
            row["peak GiB"] = torch.cuda.max_memory_allocated() / 2**30
    return row


def threads(size: int) -> Row:
    """Seconds of the joint fit of shells on one to eight threads, everything chosen."""
    scene, usual, row = make_scene(size, tilts=_TILTS), torch.get_num_threads(), Row()
    reconstruct(make_scene(32, tilts=_TILTS).noisy)
    for count in _THREADS:
        torch.set_num_threads(count)
        ((row[f"threads {count}"], _),) = in_turn([partial(reconstruct, scene.noisy)], repeats=1)
    torch.set_num_threads(usual)
    return row


ROWS: dict[str, Callable[[], Row]] = {
    "copy": copy,
    "projector, 128³": partial(projector, 128),
    "projector, 256³": partial(projector, 256),
    "PoissonGaussian": partial(noise, partial(PoissonGaussian, 0.05, -0.02, 0.9)),
    "Mixture": partial(noise, Mixture),
    "SplineFlow": partial(noise, SplineFlow),
    "joint, 64³": partial(joint, 64),
    "joint, 96³": partial(joint, 96),
    "joint, 256³": partial(joint, 256, on_cpu=False),
    "joint with the network, 96³": partial(joint, 96, field="network", on_cpu=False),
    "joint with Gaussians, 96³": partial(joint, 96, field="gaussians", on_cpu=False),
    "joint with 16 error bars, 64³": partial(joint, 64, uncertainty=16),
    "threads, 64³": partial(threads, 64),
    "threads, 128³": partial(threads, 128),
    "sirt, 256³": partial(joint, 256, "sirt"),
    "joint, 512³": partial(joint, 512, on_cpu=False),
}


def _seconds(function: Callable[[], object], device: torch.device, repeats: int = 7) -> float:
    """Median seconds of a call, after one that is not timed."""
    found = []
    for _ in range(repeats + 1):
        if device.type == "cuda":
            torch.cuda.synchronize()
        started = time.perf_counter()
        function()
        if device.type == "cuda":
            torch.cuda.synchronize()
        found.append(time.perf_counter() - started)
    return float(np.median(found[1:]))


def main() -> None:
    """Run the rows, or draw the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--skip", help="rows whose name does not contain this")
    parser.add_argument("--out", type=Path, default=RESULTS, help="JSON file; by default the one of the page")
    options = parser.parse_args()
    results, output = Results(options.out, "on a GPU"), Output(json_mode=False)
    if options.part == "page":
        FOLDER.joinpath("gpu.md").write_text(_page(results.content), encoding="utf-8")
        return
    if not torch.cuda.is_available():
        sys.exit("gpu.py: torch finds no CUDA GPU")
    for name, measure in ROWS.items():
        if options.only in name and not (options.skip and options.skip in name):
            output.line(f"{name}: {results.cell(name, measure)}")


def _page(content: dict[str, Any]) -> str:
    cells = content["cells"]
    bandwidth = cells["copy"]["GB/s"]
    fits = {
        "GPU (s)": lambda row: _shown(row, "seconds, cuda"),
        "cores (s)": lambda row: _shown(row, "seconds, cpu"),
        "volume PSNR (dB): GPU": lambda row: _shown(row, "volume PSNR (dB), cuda", 2),
        "cores": lambda row: _shown(row, "volume PSNR (dB), cpu", 2),
        "GPU memory (GiB)": lambda row: _shown(row, "peak GiB"),
    }
    projections = {
        "forward (ms)": lambda row: f"{1e3 * row['forward, cuda']:.2f}",
        "adjoint (ms)": lambda row: f"{1e3 * row['adjoint, cuda']:.2f}",
        "least (ms)": lambda row: f"{1e3 * row['least GB, cuda'] / bandwidth:.2f}",
        "cores: forward (ms)": lambda row: f"{1e3 * row['forward, cpu']:.2f}",
        "cores: adjoint (ms)": lambda row: f"{1e3 * row['adjoint, cpu']:.2f}",
    }
    scaling: dict[str, Callable[[Row], str]] = {
        f"{count} thread{'s' if count > 1 else ''} (s)": partial(_shown, key=f"threads {count}") for count in _THREADS
    }
    pixels = {
        "likelihood (ns per pixel)": lambda row: f"{1e9 * row['log_prob, cuda'] / row['pixels']:.3g}",
        "sample (ns per pixel)": lambda row: f"{1e9 * row['sample, cuda'] / row['pixels']:.3g}",
        "cores: likelihood": lambda row: f"{1e9 * row['log_prob, cpu'] / row['pixels']:.3g}",
        "cores: sample": lambda row: f"{1e9 * row['sample, cpu'] / row['pixels']:.3g}",
    }
    lines = [
        "# On a GPU",
        "",
        "Likelihoods, samples, fits and reconstructions compute on a GPU: `--device auto` takes it where torch finds one. Each "
        "row compares it with the processor cores of the same machine; the card and the number of torch's threads are at the end "
        "of the page. Two tilt axes that are not square were tried on a pretended GPU only, which computes as a processor does.",
        "",
        "```sh",
        "python -m benchmarks.pages.gpu run",
        "```",
        "",
        "## Reconstructions",
        "",
        "Everything is chosen automatically. In small volumes a GPU waits for the calls that the processor makes, hundreds in "
        "each step.",
        *_table("reconstruction of shells, 79 tilts", cells, "seconds, cuda", fits),
        "## Threads",
        "",
        "Seconds of the joint fit on the processor cores, everything chosen.",
        *_table("shells, 79 tilts", cells, f"threads {_THREADS[0]}", scaling),
        "## Projector",
        "",
        f"A copy moves {bandwidth:.0f} GB/s on this card, bytes read and written. *Least* is the time to move the matrix, the "
        "volume and the images once at that rate. Each element of the matrix reads a row of the volume, of as many voxels as "
        "there are slices: 10.6 GB for 256³, most of them from the cache.",
        *_table("projector", cells, "adjoint, cuda", projections),
        "## Noise models",
        *_table("noise model", cells, "log_prob, cuda", pixels),
    ]
    return "\n".join([*lines, measured_on([content]), ""])


def _table(of: str, cells: dict[str, Row], key: str, columns: dict[str, Callable[[Row], str]]) -> list[str]:
    """A table of the rows that have this key, between empty lines."""
    rows = [
        f"| {name} | {' | '.join(show(row) for show in columns.values())} |"
        for name, row in cells.items()
        if key in row
    ]
    return ["", f"| {of} | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|", *rows, ""]


def _shown(row: Row, key: str, digits: int = 1) -> str:
    return f"{row[key]:.{digits}f}" if key in row else "–"


if __name__ == "__main__":
    main()
