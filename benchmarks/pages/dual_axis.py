"""The gain of a second tilt axis at the same number of images, with exact and with registered geometry.

    python -m benchmarks.pages.dual_axis run     # rows not yet kept
    python -m benchmarks.pages.dual_axis page    # table and picture of dual_axis.md from the results

A phantom of 32³ is fitted by the joint fit to 41 images about one axis, or to 21 and 20 about two. The second series of
"registered" rows is turned, tilted and shifted at random, and registered by `recon.prepare`.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.pages import FOLDER, dots
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.rays import march, view_matrices, view_rays
from benchmarks.scenes import Results
from recon.methods import reconstruct
from recon.metrics.metrics import compare
from recon.series.orientation import stacked
from recon.series.prepare import prepare
from recon.series.tilt_series import TiltSeries
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, Acquisition, add_noise

PAGE = FOLDER / "dual_axis.md"
START, END = "<!-- table -->", "<!-- end of table -->"
SIZE, WIDEST = 32, 60.0
WAYS = "one axis", "two axes", "two axes, registered"
Array = NDArray[Any]
Row = dict[str, Any]


def series(volume: Array, views: Array, angles: Array, acquisition: Acquisition, scale: float, seed: int) -> TiltSeries:
    """A noisy series by the general ray marcher, shifted by (z, y, x) voxels where `views` hold a shift."""
    origins, directions = view_rays(views[:, :, :3], height=SIZE, width=SIZE)
    lines = march(torch.from_numpy(volume), origins + torch.from_numpy(views[:, None, None, :, 3]), directions)
    clean = TiltSeries(acquisition.signal(lines * scale).float().numpy(), angles, None, acquisition.mode)
    assert acquisition.noise is not None
    return add_noise(clean, acquisition.noise(), seed=seed)


def measured(phantom: str, noise: str, way: str) -> Row:
    """PSNR of the volume, and its correlation with the truth inside and outside the missing wedge of one axis."""
    acquisition, generator = ACQUISITIONS[noise], np.random.default_rng(7)
    volume = make_phantom(phantom, SIZE, generator=np.random.default_rng(0)).astype(np.float64)
    whole = np.linspace(-WIDEST, WIDEST, 41)
    scale = acquisition.peak / float(
        march(torch.from_numpy(volume), *view_rays(view_matrices(whole), height=SIZE, width=SIZE)).max()
    )
    still = np.zeros((41, 3, 1))
    make = partial(series, acquisition=acquisition, scale=scale)
    row: Row = {}
    if way == WAYS[0]:
        found = make(volume, np.concatenate([view_matrices(whole), still], 2), whole, seed=1)
    else:
        first = make(volume, np.concatenate([view_matrices(whole[::2]), still[::2]], 2), whole[::2], seed=1)
        angles, moved = whole[1::2], way == WAYS[2]
        offset, turn = generator.uniform(-2, 2), generator.uniform(-5, 5)
        views = view_matrices(angles + moved * offset, in_plane=-90 - moved * turn)
        shift = np.broadcast_to(moved * generator.uniform(-1.5, 1.5, (3, 1)), (len(angles), 3, 1))
        second = make(volume, np.concatenate([views, shift], 2), angles, seed=2)
        if moved:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                prepared = prepare(first, second_axis=second, keep_tilts=True)
            assert prepared.registration is not None
            found = prepared.tilt_series
            row = {"axis error": prepared.registration.axis - 90 - turn}
        else:
            found = stacked(first, second)
    result = reconstruct(found)
    unit = scale * (acquisition.intensity if acquisition.mode == "linear" else 1.0)
    wedge, rest = correlations(result.volume.attenuation, volume)
    psnr = compare(result.volume.attenuation, volume * unit).psnr
    return row | {"psnr": psnr, "wedge": wedge, "measured": rest}


def correlations(found: Array, truth: Array) -> tuple[float, float]:
    """Fourier correlation with the truth in the missing wedge of the first axis, and outside it, below half of Nyquist."""
    z, y, x = np.meshgrid(*[np.fft.fftfreq(SIZE)] * 3, indexing="ij")
    low = (np.sqrt(z**2 + y**2 + x**2) < 0.25) & ((z != 0) | (x != 0))
    missing = np.abs(z) > np.tan(np.deg2rad(WIDEST)) * np.abs(x)
    one, other = np.fft.fftn(found), np.fft.fftn(truth)
    parts = [low & missing, low & ~missing]
    inside, outside = (
        float((one[part] * other[part].conj()).real.sum() / np.linalg.norm(one[part]) / np.linalg.norm(other[part]))
        for part in parts
    )
    return inside, outside


def scenes() -> Iterator[tuple[str, str]]:
    """Phantom and noise."""
    for phantom in ("shells", "filaments", "particles"):
        for noise in ("gaussian", "low-dose"):
            yield phantom, noise


def tables(content: dict[str, Any]) -> str:
    """The table of the page."""
    rows = []
    for phantom, noise in scenes():
        cells = [content["cells"][f"{phantom}, {noise}/{way}"] for way in WAYS]
        figures = [
            f"{cell[name]:.{digits}f}"
            for name, digits in (("psnr", 2), ("wedge", 3), ("measured", 3))
            for cell in cells
        ]
        rows.append([phantom, noise, *figures])
    kinds = ("volume (dB)", "in the wedge", "elsewhere")
    header = ["scene", "noise", *(f"{kind}, {way}" for kind in kinds for way in WAYS)]
    picture = "![Correlation with the truth in the missing wedge of the first axis, scene by scene](dual_axis.png)"
    return "\n\n".join([picture, table(header, rows), measured_on([content])])


def main() -> None:
    """Measure what is not kept yet, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    results = Results(FOLDER / "results" / "dual_axis.json", "dual axis")
    if parser.parse_args().part == "page":
        before, rest = PAGE.read_text(encoding="utf-8").split(START)
        text = "\n\n".join([before + START, tables(results.content), END + rest.split(END)[1]])
        shown: dict[str, dict[str, float]] = {way: {} for way in WAYS}
        for name, cell in results.cells.items():
            scene, way = name.split("/")
            shown[way][scene] = cell["wedge"]
        panel = ("Missing wedge of the first axis", "Fourier correlation with the truth", shown)
        dots.save(PAGE.with_suffix(".png"), [panel], columns=1)
        PAGE.write_text(text, encoding="utf-8")
        return
    torch.set_num_threads(1)
    for phantom, noise in scenes():
        for way in WAYS:
            name = f"{phantom}, {noise}/{way}"
            print(name, results.cell(name, partial(measured, phantom, noise, way)), flush=True)


if __name__ == "__main__":
    main()
