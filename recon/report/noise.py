"""Charts of the fitted or given noise model of a reconstruction, compared with the data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from noiseflow.metrics.evaluation import residual_masses
from noiseflow.report import COLOURS, add_legend, new_chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_LEVELS = 24
_HISTOGRAMS = 5
_LEAST_PIXELS = 200
_MOST_PIXELS = 2_000_000

Values = NDArray[np.float32]


def noise_charts(noise_model: nn.Module, signal: Values, observation: Values) -> list[Figure]:
    """Quantiles of the noise against the signal, then histograms at a few signals: data, and exact values of the model.

    Args:
        noise_model: the noise model.
        signal, observation: (N,) predicted noise-free pixels and measured pixel values, detector units.
    """
    stride = -(-signal.size // _MOST_PIXELS)
    signal, observation = signal[::stride], observation[::stride]
    charts = [_quantile_chart(noise_model, signal, observation, _by_signal(signal, _LEVELS))]
    for number, group in enumerate(_by_signal(signal, _HISTOGRAMS)):
        charts.append(_histogram(noise_model, signal[group], observation[group], legend=number == 0))
    return charts


def _by_signal(signal: Values, count: int) -> list[NDArray[np.intp]]:
    """Groups of pixels in equal steps of the signal, without groups that have too few pixels."""
    low, high = (float(end) for end in np.quantile(signal, (0.001, 0.999)))
    edges = np.linspace(low, high, count + 1)
    step = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, count - 1)
    ordered = np.split(np.argsort(step, kind="stable"), np.cumsum(np.bincount(step, minlength=count))[:-1])
    return [group for group in ordered if group.size >= min(_LEAST_PIXELS, signal.size // count)]


def _quantile_chart(
    noise_model: nn.Module, signal: Values, observation: Values, groups: list[NDArray[np.intp]]
) -> Figure:
    level = np.array([signal[group].mean() for group in groups])
    data = np.array([np.quantile(observation[group] - signal[group], _QUANTILES) for group in groups])
    figure, axis = new_chart("Noise by signal", x="signal, detector units", y="pixel value − signal")
    model = _model_quantiles(noise_model, level)
    for number, share in enumerate(_QUANTILES):
        middle = share == 0.5
        style: dict[str, Any] = {"color": COLOURS["accent"], "linewidth": 2.0 if middle else 1.1}
        axis.plot(level, model[:, number], **style, label="model" if middle else None)
        points: dict[str, Any] = {"color": COLOURS["warm"], "markersize": 3, "linestyle": ""}
        axis.plot(level, data[:, number], "o", **points, label="data: 5, 25, 50, 75, 95 %" if middle else None)
    add_legend(axis)
    return figure


def _model_quantiles(noise_model: nn.Module, level: NDArray[Any]) -> NDArray[Any]:
    device = next((parameter.device for parameter in noise_model.parameters()), torch.device("cpu"))
    with torch.no_grad():
        signal = torch.as_tensor(level, dtype=torch.float32, device=device)
        distribution = noise_model(signal)
        quantiles = [distribution.icdf(torch.full_like(signal, share)) - signal for share in _QUANTILES]
    return torch.stack(quantiles, 1).cpu().numpy()


def _histogram(noise_model: nn.Module, signal: Values, observation: Values, *, legend: bool) -> Figure:
    residual = observation - signal
    low, high = np.quantile(residual, (0.001, 0.999))
    inner = np.linspace(low, max(float(high), float(low) + 1e-6 * (1 + abs(float(low)))), 49)
    edges = np.concatenate([[-np.inf], inner, [np.inf]])
    device = next((parameter.device for parameter in noise_model.parameters()), torch.device("cpu"))
    masses = residual_masses(noise_model, torch.from_numpy(signal).to(device), torch.from_numpy(edges))[1:-1]
    counts = np.histogram(residual, inner)[0]
    width = inner[1] - inner[0]
    ends = (f"{end:.0f}" if abs(end) >= 1000 else f"{end:.3g}" for end in (signal.min(), signal.max()))
    figure, axis = new_chart(f"signal {' … '.join(ends)}", x="pixel value − signal", y="density")
    axis.stairs(counts / (residual.size * width), inner, fill=True, color=COLOURS["data"], label="data")
    axis.stairs(masses / width, inner, color=COLOURS["accent"], linewidth=1.6, label="model")
    axis.set_yscale("log")
    axis.set_ylim(bottom=max(0.2 / (residual.size * width), 1e-4 * masses.max() / width))
    if legend:
        add_legend(axis)
    return figure
