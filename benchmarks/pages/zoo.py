"""The zoo: noise models of real detectors, fitted to data that may be redistributed, and the page of each.

    python -m benchmarks.pages.zoo --data DIR [--model miro-scmos ...]

DIR holds the folders ``exposures_miro``, ``detector_zhuang``, ``flatdark_tooth`` and ``tilt_needle_256``. Each model is fitted to
half of its pixels or frames. The statistics in its file, its page and its picture are those of the other half.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import noiseflow
from noiseflow import zoo
from noiseflow.metrics.spatial import correlation_kernel
from noiseflow.models.wrapper import as_noise_model

PAGES = Path(__file__).parents[2] / "docs" / "zoo"
LEVELS = 12
BRIGHTEST = -31860  # counts, of the vacuum around the needle
QUANTILES = (0.01, 0.25, 0.75, 0.99)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fitted:
    """A fitted model and the data that judge it.

    Attributes:
        model: the noise model.
        signal, observation: judging pixels; images if the model needs images. Where the signal is the mean of n repeated
            frames, observation minus signal is larger by √(n/(n − 1)) than in the files, which makes its variance unbiased.
        fitted_to: what the model was fitted to, for the page.
        deviations: where model and detector differ, for the page.
    """

    model: noiseflow.NoiseModelBase
    signal: Tensor
    observation: Tensor
    fitted_to: str
    deviations: str


def _selected(signal: Tensor, observation: Tensor) -> tuple[str, noiseflow.NoiseModelBase, Tensor, Tensor]:
    """Name and model that `select` chooses for 200 000 random pixels, and 200 000 others that judge it."""
    order = torch.from_numpy(np.random.default_rng(0).permutation(signal.numel()))
    fitted, judged = order[:200_000], order[200_000:400_000]
    chosen = noiseflow.select(signal[fitted], observation[fitted]).chosen
    return chosen.name, as_noise_model(chosen.model), signal[judged], observation[judged]


def _miro(folder: Path) -> Fitted:
    from calibration import align_pair, read_pairs

    signals, observations = [], []
    for channel in (1, 2, 3):
        for time in ("010", "020", "050", "100"):
            paths = [folder / "exposures_miro" / f"channel{channel}_{name}.tif" for name in (f"{time}ms", "long")]
            aligned = align_pair(read_pairs(paths[:1], paths[1:])[0])
            signals.append(torch.from_numpy(aligned.signal[aligned.mask]).float())
            observations.append(torch.from_numpy(aligned.observation[aligned.mask]).float())
    signal, observation = torch.cat(signals), torch.cat(observations)
    name, *chosen = _selected(signal, observation)
    return Fitted(
        *chosen,
        f"200 000 random pixels of twelve pairs of exposures (three colours; 10, 20, 50 and 100 ms against a long one); "
        f"`select` chose {name}",
        "neighbouring pixels correlate by 0.01 to 0.06, and pixels have their own gain and offset; the model describes pixels "
        "drawn at random",
    )


def _zhuang(folder: Path) -> Fitted:
    import tifffile

    def read(name: str) -> Array:
        return np.asarray(tifffile.imread(folder / "detector_zhuang" / name), dtype=np.float64)

    frames, gain, offset, variance = (
        read(f"{name}.tif") for name in ("frames", "gain_counts_per_electron", "offset_counts", "variance_counts2")
    )
    usual = float(np.median(gain))
    inner = noiseflow.PoissonGaussian(gain=usual, offset=0.0, read_noise=float(np.median(np.sqrt(variance)) / usual))
    maps = {"gain": gain / usual, "offset": offset, "variance": variance}
    model = noiseflow.WithMaps(
        noiseflow.Digitised(inner, step=1.0), **{name: torch.from_numpy(each).float() for name, each in maps.items()}
    )
    mean = frames.mean(0)
    signal = np.where(mean < np.quantile(mean, 0.6), (mean - offset) / maps["gain"], np.nan)
    # successive frames: what blinks slowly cancels
    pairs = (frames[1:] - frames[:-1]) / np.sqrt(2) + mean
    return Fitted(
        model,
        torch.from_numpy(np.broadcast_to(signal, pairs.shape).copy()).float(),
        torch.from_numpy(pairs).float(),
        "nothing: gain, offset and variance of each of 256 × 256 pixels are the makers' calibration; the dim 60 % of the pixels "
        "of 11 frames judge it, by differences of successive frames",
        "emitters blink, so that bright pixels of the frames cannot judge the model",
    )


def _tooth(folder: Path) -> Fitted:
    import h5py

    with h5py.File(folder / "flatdark_tooth" / "tooth.h5") as file:
        darks, flats = (np.asarray(file["exchange"][name], float) for name in ("data_dark", "data_white"))
    flats *= flats.mean() / flats.mean((1, 2), keepdims=True)
    signal, observation = [], []
    for frames in (darks, flats):
        mean = frames.mean(0, keepdims=True)
        signal.append(np.broadcast_to(mean, frames.shape))
        observation.append(mean + (frames - mean) * np.sqrt(len(frames) / (len(frames) - 1)))
    signals, observations = (torch.from_numpy(np.concatenate(each)) for each in (signal, observation))
    first = torch.arange(len(signals)) % 2 == 0
    dark, bright = (float((observations - signals)[part][::2].var()) for part in (slice(0, 10), slice(10, 20)))
    offset = float(darks.mean())
    gain = (bright - dark) / (float(flats.mean()) - offset)
    model = noiseflow.PoissonGaussian(gain=gain, offset=offset, read_noise=dark**0.5 / gain)
    kernel = correlation_kernel(model, signals[first].float(), observations[first].float())
    return Fitted(
        noiseflow.Correlated(model, kernel),
        signals[~first].float(),
        observations[~first].float(),
        "five darks and five flats of 2 × 640 pixels, each averaged from 2 × 2 detector pixels; gain from the variances, "
        "correlation from the residuals",
        "signals lie near 105 or 28 000 counts, and what lies between is shot noise by assumption; some pixels are far noisier "
        "in the dark (kurtosis 5), which one read noise cannot describe",
    )


def _needle(folder: Path) -> Fitted:
    from scipy import ndimage

    images = np.asarray(noiseflow.io.read(folder / "tilt_needle_256" / "needle_256_raw.mrc").data, dtype=np.float64)
    around = (ndimage.uniform_filter(images, (1, 5, 5)) * 25 - images) / 24
    dark = ndimage.maximum_filter(images, (1, 9, 9)) < BRIGHTEST
    signal, observation = (torch.from_numpy(each[dark]).float() for each in (around, images))
    name, *chosen = _selected(signal, observation)
    return Fitted(
        *chosen,
        "200 000 random pixels beside the specimen, from 77 raw tilts of 256 × 256 pixels; the signal is the mean of the 24 "
        f"pixels around each; `select` chose {name}",
        f"only signals below {BRIGHTEST} counts (vacuum, at most about 30 counts above the darkest): the bright specimen differs "
        "from its surroundings by structure, which hides the noise; the deviation is about 2 % too large, because the mean of 24 "
        "pixels is itself noisy",
    )


@dataclass(frozen=True)
class Detector:
    """A detector of the zoo.

    Attributes:
        title: what it is.
        source: repository and licence of the data.
        fit: function from the data folder to the fitted model.
    """

    title: str
    source: str
    fit: Callable[[Path], Fitted]


DETECTORS = {
    "miro-scmos": Detector(
        "an sCMOS camera", "ShuJiaLab/MIRO demo data; BSD-3-Clause, © 2023 Biagio Mandracchia", _miro
    ),
    "zhuang-scmos": Detector(
        "a calibrated sCMOS camera, with maps of its pixels",
        "test data of ZhuangLab/storm-analysis; MIT, © 2016 Zhuang Lab, Harvard University",
        _zhuang,
    ),
    "tooth-xray": Detector(
        "an X-ray camera behind a scintillator",
        "tomopy/tomopy; BSD-3-Clause, © 2013-2019 UChicago Argonne, LLC",
        _tooth,
    ),
    "needle-haadf": Detector(
        "a HAADF detector of a scanning transmission electron microscope, at low signals",
        "test data of usnistgov/etspy; NIST, public domain",
        _needle,
    ),
}


def statistics(signal: Tensor, residual: Tensor) -> list[dict[str, float]]:
    """Mean, deviation, skewness and quantiles of residuals in levels of the signal with equally many pixels."""
    s, r = (each.reshape(-1).double().numpy() for each in (signal, residual))
    s, r = s[np.isfinite(s)], r[np.isfinite(s)]
    edges = np.quantile(s, np.linspace(0, 1, LEVELS + 1))
    level = np.clip(np.searchsorted(edges, s, side="right") - 1, 0, LEVELS - 1)
    rows = []
    for each in np.unique(level):
        inside = r[level == each]
        about = inside - inside.mean()
        row = {"signal": float(s[level == each].mean()), "count": inside.size, "mean": float(inside.mean())}
        row |= {"deviation": float(inside.std()), "skewness": float((about**3).mean() / inside.std() ** 3)}
        rows.append(row | {f"q{100 * q:g}": float(np.quantile(inside, q)) for q in QUANTILES})
    return rows


@torch.no_grad()
def drawn(model: nn.Module, signal: Tensor, *, seed: int = 0, successive: bool = False) -> Tensor:
    """Observation minus signal of a draw of the model at a signal; NaN where the signal is.

    With `successive`, differences of two draws over √2, as for the camera whose scene is not known.
    """
    generator = torch.Generator().manual_seed(seed)
    known = torch.nan_to_num(signal, nan=float(signal[torch.isfinite(signal)].mean()))
    if successive:
        first, second = (model(known).sample(generator=generator) for _ in range(2))
        return torch.where(torch.isfinite(signal), (second - first) / np.sqrt(2), torch.nan)
    return torch.where(torch.isfinite(signal), model(known).sample(generator=generator) - known, torch.nan)


def build(name: str, data: Path) -> None:
    """Fit a model and write its file, its page and its picture."""
    detector = DETECTORS[name]
    found = detector.fit(data)
    successive = isinstance(found.model, noiseflow.WithMaps)
    residual = found.observation - found.signal
    if successive:
        residual = found.observation - found.observation.mean(0) + 0 * found.signal
    provenance = {
        "detector": detector.title,
        "source": detector.source,
        "fitted_to": found.fitted_to,
        "deviations": found.deviations,
        "made_by": f"python -m benchmarks.pages.zoo --data DIR --model {name}",
        "statistics": statistics(found.signal, residual),
    }
    if found.model.fitted_range is None:  # set from known parameters, not by a fit
        known = found.signal[torch.isfinite(found.signal)]
        found.model.fitted_range = float(known.min()), float(known.max())
    path = zoo.FOLDER / f"{name}.safetensors"
    path.parent.mkdir(exist_ok=True)
    noiseflow.save(found.model, path, units="counts", provenance=provenance)
    model = zoo.load(name)
    sampled = drawn(model, found.signal, successive=successive)
    rows = statistics(found.signal, sampled)
    PAGES.mkdir(exist_ok=True)
    _draw(name, found.signal, residual, sampled, provenance["statistics"], rows)
    (PAGES / f"{name}.md").write_text(_page(name, model, provenance, rows, path.stat().st_size), encoding="utf-8")


def _draw(name: str, signal: Tensor, residual: Tensor, sampled: Tensor, data: Any, model: Any) -> None:
    from noiseflow.report import new_figure

    figure, axes = new_figure(3, width=13, height=3.6)
    for rows, label, style in ((data, "data", "o"), (model, "model", "-")):
        at = [row["signal"] for row in rows]
        axes[0, 0].plot(at, [row["deviation"] for row in rows], style, label=label)
        axes[0, 1].plot(at, [row["skewness"] for row in rows], style, label=label)
    axes[0, 0].set(xlabel="signal (counts)", ylabel="standard deviation of the noise (counts)")
    axes[0, 1].set(xlabel="signal (counts)", ylabel="skewness of the noise")
    both = [each[torch.isfinite(each)].numpy() for each in (residual, sampled)]
    edges = np.linspace(*np.quantile(both[0], [0.0005, 0.9995]), 80)
    for values, label in zip(both, ("data", "model"), strict=True):
        axes[0, 2].hist(values, edges, density=True, histtype="step", log=True, label=label)
    axes[0, 2].set(xlabel="observation − signal (counts)", ylabel="density (1/count)")
    for axis in axes[0]:
        axis.legend(fontsize=8)
    figure.savefig(PAGES / f"{name}.png", dpi=80, facecolor="white")


def _page(name: str, model: nn.Module, provenance: dict[str, Any], rows: list[dict[str, float]], size: int) -> str:
    header = "| signal | pixels | deviation, data | model | skewness, data | model |\n|---:|---:|---:|---:|---:|---:|\n"
    table = header + "\n".join(
        f"| {d['signal']:.6g} | {d['count']:.0f} | {d['deviation']:.4g} | {m['deviation']:.4g} | {d['skewness']:.2f} | "
        f"{m['skewness']:.2f} |"
        for d, m in zip(provenance["statistics"], rows, strict=True)
    )
    return f"""# {name}: {provenance["detector"]}

![Deviation and skewness of the noise by signal, and histogram of the noise, of data and model]({name}.png)

```python
import noiseflow

detector = noiseflow.zoo.load("{name}")
noisy = detector(clean).sample()  # counts
```

- **Data**: {provenance["source"]}.
- **Fitted to**: {provenance["fitted_to"]}.
- **Known deviations**: {provenance["deviations"]}.
- **Model**: `{model!r}`, {size / 1000:.0f} kB.

Noise of the data and of one draw of the model at the same signals, in counts, by signal:

{table}

Written by `{provenance["made_by"]}`.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", nargs="+", choices=DETECTORS, default=list(DETECTORS))
    options = parser.parse_args()
    for name in options.model:
        build(name, options.data)
        print(f"wrote {zoo.FOLDER / name}.safetensors and docs/zoo/{name}.md", flush=True)


if __name__ == "__main__":
    main()
