"""The figure of the noise models' results page."""

from __future__ import annotations

from typing import Any

from benchmarks.pages.noise_accuracy import MODELS, NOISES, OURS
from benchmarks.pages.noise_speed import SPEED_MODELS
from benchmarks.pages.noise_truths import noises

GOAL = 0.005
RIVALS = {
    "zuko": "zuko NSF",
    "normflows": "normflows RQS",
    "paper": "paper's flow",
    "paper-as-published": "paper, as published",
}
Row = dict[str, Any]

_COLOURS = {
    "automatic": "#D55E00",
    "RadialFlow": "#0072B2",
    "SplineFlow": "#56B4E9",
    "PhysicsFlow": "#009E73",
    "zuko": "#CC79A7",
    "normflows": "#E69F00",
    "paper": "#7f7f7f",
}


def ordered(rows: list[Row]) -> list[Row]:
    """Rows in the order of the models."""
    return sorted(rows, key=lambda row: SPEED_MODELS.index(row["model"]))


def draw(content: dict[str, Any]) -> Any:
    """Accuracy per noise and model against the goal, speed as ratios, and time to fit against divergence."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.25, 1])
    _draw_accuracy(figure.add_subplot(grid[0, :]), content.get("accuracy", []))
    _draw_speed(figure.add_subplot(grid[1, 0]), content.get("speed", []))
    _draw_fits(figure.add_subplot(grid[1, 1]), content.get("accuracy", []))
    return figure


def _draw_accuracy(axis: Any, rows: list[Row]) -> None:
    models = [model for model in MODELS if model != "paper-as-published"]
    for place, model in enumerate(models):
        found = [row for row in rows if row["model"] == model]
        x = [NOISES.index(row["noise"]) + 0.06 * (place - len(models) / 2) for row in found]
        y = [max(row["kl"], 1e-5) for row in found]
        star = model == "automatic"
        colour = _COLOURS.get(model, "#c7a76c")
        marker = "*" if star else "o" if model in OURS else "x"
        axis.scatter(
            x, y, s=110 if star else 26, c=colour, marker=marker, label=RIVALS.get(model, model), zorder=3 + star
        )
    axis.axhline(GOAL, color="black", linewidth=1, linestyle="--")
    axis.text(len(NOISES) - 0.45, GOAL, " goal", va="center", fontsize=8)
    axis.set(yscale="log", ylabel="KL to the truth (nats per pixel)", xlim=(-0.6, len(NOISES) - 0.2))
    axis.set_xticks(range(len(NOISES)), [noises()[noise].title.replace(", ", ",\n") for noise in NOISES], fontsize=7)
    axis.tick_params(axis="x", rotation=25)
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=7, ncols=5, loc="upper center", bbox_to_anchor=(0.5, 1.17))


def _draw_speed(axis: Any, rows: list[Row]) -> None:
    for place, what, goal, colour in ((0, "sample", 1.5, "#0072B2"), (1, "log_prob", 3.0, "#D55E00")):
        found = [row for row in ordered(rows) if row["what"] == what and row["device"] == "cpu"]
        y = [SPEED_MODELS.index(row["model"]) + 0.36 * place - 0.18 for row in found]
        ratios = [row["later"] / row["yardstick"] for row in found]
        name = found[0]["yardstick_name"] if found else ""
        axis.barh(y, ratios, height=0.34, color=colour, label=f"{what} / {name}")
        axis.axvline(goal, color=colour, linestyle="--", linewidth=1)
        for height, ratio in zip(y, ratios, strict=True):
            axis.text(ratio * 1.1, height, f"{ratio:.2g}", va="center", fontsize=7)
    axis.set_yticks(range(len(SPEED_MODELS)), [RIVALS.get(model, model) for model in SPEED_MODELS], fontsize=8)
    axis.invert_yaxis()
    axis.set(xscale="log", xlabel="time / yardstick in the same run (dashed: goals)")
    axis.margins(x=0.15)
    axis.legend(fontsize=7)


def _draw_fits(axis: Any, rows: list[Row]) -> None:
    for model in ("automatic", "RadialFlow", "SplineFlow", "PhysicsFlow", "zuko", "normflows", "paper"):
        found = [row for row in rows if row["model"] == model]
        axis.scatter(
            [row["seconds"] for row in found],
            [max(row["kl"], 1e-5) for row in found],
            s=28,
            c=_COLOURS[model],
            marker="*" if model == "automatic" else "o" if model in OURS else "x",
            label=RIVALS.get(model, model),
        )
    axis.axhline(GOAL, color="black", linewidth=1, linestyle="--")
    axis.set(xscale="log", yscale="log", xlabel="time to fit (s), one dot per noise", ylabel="KL (nats per pixel)")
    axis.legend(fontsize=7)
