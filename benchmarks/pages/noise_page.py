"""The results page of the noise models, noise_models.md, and its figure, both from results/noise_models.json alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.pages import FOLDER
from benchmarks.pages.noise_accuracy import MODELS, NOISES
from benchmarks.pages.noise_figure import GOAL, RIVALS, Row, draw, ordered
from benchmarks.pages.noise_laws import MODELS as FITTED
from benchmarks.pages.noise_laws import RIVALS as THEIRS
from benchmarks.pages.noise_laws import UNSEEN, laws
from benchmarks.pages.noise_truths import noises
from noiseflow.io import atomic_path

ALIKE = 3e-4
PAGE = FOLDER / "noise_models.md"
FIGURE = FOLDER / "noise_models.png"


def write(content: dict[str, Any]) -> None:
    """Write page and figure."""
    with atomic_path(PAGE) as partial:
        partial.write_text(page(content), encoding="utf-8")
    with atomic_path(FIGURE) as partial:
        draw(content).savefig(partial, format="png", dpi=110, facecolor="white")


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    parts = [_head(content), _unseen(), _accuracy(content), _speed(content), _rivals(content), _exposures(content)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _head(content: dict[str, Any]) -> str:
    machines = sorted({row["machine"] for section in content.values() for row in section})
    return "\n".join(
        [
            "# Noise models: accuracy and speed",
            "",
            "Written by `python -m benchmarks.pages.noise_models page` from `results/noise_models.json`; "
            "each row is one command.",
            "",
            "![Divergence from the truth for every noise and model, speed, and time to fit](noise_models.png)",
            "",
            "Measured on:",
            "",
            *(f"- {machine}" for machine in machines),
        ]
    )


def _unseen() -> str:
    """Noises that no model of the library contains, from results/noise_laws.json."""
    path = FOLDER / "results" / "noise_laws.json"
    rows: dict[str, Row] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if not rows:
        return ""
    models = [model for model in ("select", *FITTED, *THEIRS) if any(key.endswith(f" {model}") for key in rows)]
    table = [
        "| noise | " + " | ".join(f"{model}, KL" for model in models) + " | chosen | processor time, `select` = 1 |",
        "|---|" + "---:|" * len(models) + "---|---|",
    ]
    for name, law in laws().items():
        found = {model: rows[f"{name} {model}"] for model in models if f"{name} {model}" in rows}
        if "select" not in found:
            continue
        least = min(row["kl"] for row in found.values()) + ALIKE
        shown = (f"{found[m]['kl']:.5f}" if m in found else "" for m in models)
        marked = (
            f"**{text}**" if m in found and found[m]["kl"] <= least else text
            for m, text in zip(models, shown, strict=True)
        )
        ratios = (f"{m} {row['seconds'] / found['select']['seconds']:.2g}" for m, row in found.items() if m != "select")
        title = f"{law.title} (*unseen*)" if name in UNSEEN else law.title
        chosen = f"{found['select']['model']}, {found['select']['seconds']:.1f} s"
        table.append(f"| {title} | {' | '.join(marked)} | {chosen} | {', '.join(ratios)} |")
    text = (
        "Each model is fitted to 50 000 pixels of a noise that no model contains; the divergence from the exact law is "
        "computed by quadrature at 48 signals. Bold: within 0.0003 nats per pixel of the least of the row. The models of "
        "zuko get the settings that the search below found best, about ten seconds each, and `noiseflow.Digitised` around "
        "them where the data are rounded or clipped. The first twelve noises were used to develop `select`; those marked "
        "*unseen* were defined before any model was fitted to them; the phase and the angle were then used to develop "
        "`Wrapped`, and pairs of peaks, saturation, flicker, means, medians and Weibull speckle to develop the last fit of "
        "`select`.\n\n"
        "```sh\npython -m benchmarks.pages.noise_laws\n```\n\n"
        f"Measured by {_commits(rows.values())}, on one thread of a machine that other programs used too. Of one commit, ratios "
        "within a row are comparable."
    )
    return "\n\n".join(["## Noises that no model contains", text, "\n".join(table)])


def _commits(rows: Iterable[Row]) -> str:
    """The commits of the rows that have one, with the number of rows of each."""
    counts = Counter(f"commit {row['commit']}, {row['date']}" for row in rows if "commit" in row)
    return "; ".join(f"{commit} ({count} figures)" for commit, count in counts.items())


def _accuracy(content: dict[str, Any]) -> str:
    rows: list[Row] = content.get("accuracy", [])
    if not rows:
        return ""
    size, steps = rows[0]["size"], rows[0]["num_steps"]
    draws = f", mean of {rows[0]['jsd_draws']} draws" if rows[0].get("jsd_draws", 1) > 1 else ""
    counts = Counter(RIVALS.get(row["model"], row["model"]) for row in rows if "commit" not in row)
    old = ", ".join(f"{count} of {model}" for model, count in counts.items())
    earlier = f"in rows measured earlier ({old}), time on a clock" if old else "no row is older"
    text = (
        f"Each model is fitted to four fifths of {size}² pixels of a clean and a noisy image, and judged on the last fifth. The "
        f"models of this library take {steps} steps.\n\n"
        "- **KL**: divergence from the truth in nats per pixel, on new noise drawn four times for each pixel.\n"
        "- **NLL gap**: negative log-likelihood of the last fifth minus that of the truth on the same pixels, in nats per "
        "pixel.\n"
        "- **JSD/floor**: marginal Jensen–Shannon divergence of new residuals over its mean under the model itself"
        f"{draws}; 1 is perfect.\n"
        f"- **fit (s)**: processor time of one thread, measured by {_commits(rows)}; {earlier}.\n\n"
        "To measure one row, run:\n\n"
        "```sh\npython -m benchmarks.pages.noise_models accuracy --noise gamma --model SplineFlow\n```"
    )
    parts = [
        "## Accuracy against known truth",
        text,
        _summary(rows),
        "### KL to the truth (nats per pixel)",
        _matrix(rows),
    ]
    parts += ["### All figures", *(_noise_table(rows, noise) for noise in NOISES)]
    return "\n\n".join(part for part in parts if part)


def _summary(rows: list[Row]) -> str:
    lines = []
    for model, goal, left_out in (("automatic", GOAL, ()), ("SplineFlow", 0.01, _RESOLVED)):
        found = [row for row in rows if row["model"] == model and row["noise"] not in left_out]
        if found:
            worst = max(found, key=lambda row: row["kl"])
            met = sum(row["kl"] <= goal for row in found)
            beyond = " other than resolved single electrons (read noise 0.2)" if left_out else ""
            lines.append(
                f"- `{model}`: KL ≤ {goal:g} nats on {met} of {len(found)} noises{beyond}; "
                f"largest {worst['kl']:.4f} ({worst['noise']})."
            )
    missing = len(NOISES) * len(MODELS) - len(rows)
    if missing:
        lines.append(
            f"- {missing} of {len(NOISES) * len(MODELS)} rows are not measured yet: `accuracy --resume` runs them."
        )
    chosen = [row for row in rows if row["model"] == "automatic"]
    if chosen:
        worst = max(chosen, key=lambda row: row["jsd"] / row["jsd_floor"])
        met = sum(row["jsd"] <= 1.5 * row["jsd_floor"] for row in chosen)
        ratio = worst["jsd"] / worst["jsd_floor"]
        lines.append(
            f"- `automatic`: JSD ≤ 1.5 × floor on {met} of {len(chosen)} noises; largest ratio {ratio:.2f} ({worst['noise']})."
        )
    return "\n".join(lines)


_RESOLVED = tuple(noise for noise in NOISES if noise.endswith("-0.2"))


def _matrix(rows: list[Row]) -> str:
    models = [model for model in MODELS if any(row["model"] == model for row in rows)]
    body = []
    for noise in NOISES:
        found = {row["model"]: row for row in rows if row["noise"] == noise}
        if found:
            best = min((row["kl"] for row in found.values()), default=0.0)
            cells = [_kl_cell(found.get(model), best) for model in models]
            body.append([noises()[noise].title, *cells])
    return table(["noise", *(RIVALS.get(model, model) for model in models)], body) + (
        "\n\nBold: the least, and all within two standard errors of it."
    )


def _kl_cell(row: Row | None, best: float) -> str:
    if row is None:
        return "–"
    text = f"{row['kl']:.4f}" if row["kl"] < 10 else f"{row['kl']:.1f}"
    return f"**{text}**" if row["kl"] <= best + 2 * row["kl_error"] else text


def _noise_table(rows: list[Row], noise: str) -> str:
    found = [row for model in MODELS for row in rows if row["noise"] == noise and row["model"] == model]
    if not found:
        return ""
    body = [
        [
            RIVALS.get(row["label"], row["label"]),
            f"{row['kl']:.4f} ± {row['kl_error']:.4f}",
            f"{row['nll']:.4f}",
            f"{row['nll_gap']:.4f}",
            f"{1e4 * row['jsd']:.2f}",
            f"{row['jsd'] / row['jsd_floor']:.2f}",
            f"{row['seconds']:.1f}",
            f"{row['integral']:.3f}" if "integral" in row else "1",
        ]
        for row in found
    ]
    header = ["model", "KL ± s.e.", "NLL", "NLL gap", "JSD ×10⁴", "JSD/floor", "fit (s)", "integral"]
    return f"**{noises()[noise].title}** (`--noise {noise}`)\n\n{table(header, body)}"


def _speed(content: dict[str, Any]) -> str:
    rows: list[Row] = content.get("speed", [])
    if not rows:
        return "## Speed\n\nNot measured yet, neither on a CPU nor on a GPU (`speed`, `speed --device cuda`)."
    fits = [row for row in ordered(rows) if row["what"] == "fit"]
    timed = [row for row in ordered(rows) if row["what"] != "fit"]
    body = [
        [
            RIVALS.get(row["model"], row["model"]),
            row["what"],
            row["device"],
            f"{row['pixels']:.0e}",
            f"{1e3 * row['first']:.0f}",
            f"{1e3 * row['later']:.1f}",
            f"{1e3 * row['yardstick']:.1f} ({row['yardstick_name']})",
            f"{row['first'] / row['yardstick']:.2f}",
            f"{row['later'] / row['yardstick']:.2f}",
            f"{row['pixels'] / row['later'] / 1e9:.3f}",
        ]
        for row in timed
    ]
    header = ["model", "call", "device", "pixels", "first (ms)", "later (ms)", "yardstick (ms)", "first / yardstick"]
    header += ["later / yardstick", "Gpx/s"]
    note = (
        "" if any(row["device"] == "cuda" for row in timed) else "\n\nOn a GPU: not measured (`speed --device cuda`)."
    )
    fitted = [
        [RIVALS.get(row["model"], row["model"]), f"{row['seconds']:.1f}", f"{row['kl']:.4f} ± {row['kl_error']:.4f}"]
        for row in fits
    ]
    return "\n\n".join(
        [
            "## Speed",
            "Medians of calls that take turns in one run, `python -m benchmarks.pages.noise_models speed`; the first call makes "
            "our tables. Goals, of the later calls: `sample` at most 1.5 × NumPy's Poisson generator, `log_prob` at most 3 × "
            "torch's normal density; a fit of 512² pixels to within 0.005 nats in at most 5 s. Other packages' likelihoods are "
            "timed on 10⁶ pixels.",
            table(header, body) + note,
            "Fit of a 512² pair with gamma-skewed noise:",
            table(["model", "fit (s)", "KL ± s.e. (nats)"], fitted),
        ]
    )


def _rivals(content: dict[str, Any]) -> str:
    rows: list[Row] = content.get("search", [])
    text = (
        "## The other packages\n\n"
        "- **zuko**: `zuko.flows.NSF` of one feature and one context. **normflows**: `ConditionalNormalizingFlow` of "
        "autoregressive rational-quadratic splines (its coupling layers need two features or more). Residuals and signals are "
        "standardised as their documentation asks; 16 bins, two hidden layers of 64, 500 steps of Adam in the same loop as "
        "ours. They have no rounding and no saturation: where the data show them, they get `noiseflow.Digitised` around them, "
        "as our models do.\n"
        "- **Paper's flow**: four radial layers and four conditional ones, intensities on [0, 1], SGD of momentum 0.9 on the "
        "summed likelihood of 16 patches of 16² pixels at rate 5e-7 (the paper's, where the clean image is known; 5e-5 "
        "diverges here), for 1500 steps where the authors take 400 000. *As published* takes each layer's log-derivative at "
        "its output while it learns: the last column of the tables above is the integral of what it then calls a density. It is "
        "judged by the density of what it samples, behind the detected rounding and clipping limits."
    )
    if not rows:
        return text
    body = [
        [
            RIVALS[row["model"]],
            *(f"{value:g}" for value in row["setting"].values()),
            f"{row['kl']:.4f}",
            f"{row['seconds']:.0f}",
        ]
        for row in rows
    ]
    header = ["model", *rows[0]["setting"], "mean KL", "seconds a fit"]
    return (
        f"{text}\n\nSettings searched, mean KL over gamma-skewed and Student-t noise, {rows[0]['size']}² pixels, 500 steps:\n\n"
        + table(header, body)
    )


_PUBLISHED = (("Poisson", 0.96, 0.99, 0.15), ("Gaussian", 1.07, 0.99, 0.12), ("flow", 0.58, 1.00, 0.03))


def _exposures(content: dict[str, Any]) -> str:
    rows: list[Row] = content.get("exposures", [])
    if not rows:
        return ""
    parts = [
        "## The paper's noise table",
        "Half of the pixels of each pair fit the models, the other half judges them. JSD ×10⁻², Bhattacharyya coefficient BC and "
        "distance ×10⁻¹, in nats, of residuals against the model's exact masses of 64 bins; *floor* is the mean under the model "
        "itself. *JSD/signal bin* is the mean over 16 bins of the signal. The real exposures are short ones of a fixed cell on "
        "an sCMOS camera against a long exposure, registered and scaled, the long one's own noise taken off.\n\n"
        "```sh\npython -m benchmarks.pages.noise_models exposures --data DIR\n```",
    ]
    if not any(row["real"] for row in rows):
        parts.append("Real exposures: not measured.")
    for data in dict.fromkeys(row["data"] for row in rows):
        found = [row for row in rows if row["data"] == data]
        header = ["model", "JSD", "floor", "JSD/signal bin", "floor", "BC", "floor", "distance", "floor", "NLL ± s.e."]
        parts += [
            f"**{data}**, {found[0]['num_pixels']} pixels",
            table(header, [_exposure_cells(row) for row in found]),
        ]
    published = [[name, f"{jsd:.2f}", f"{bc:.2f}", f"{distance:.2f}"] for name, jsd, bc, distance in _PUBLISHED]
    parts += [
        "Published for the paper's own STEM exposures, without floors, bins or scales (other data: not to be compared figure by "
        "figure; the scales are inferred from the paper's own columns):",
        table(["model", "JSD", "BC", "distance"], published),
    ]
    return "\n\n".join(parts)


def _exposure_cells(row: Row) -> list[str]:
    percent = (f"{100 * row[name]:.3f}" for name in ("jsd", "jsd_floor", "jsd_per_signal", "jsd_per_signal_floor"))
    coefficient = (f"{row[name]:.5f}" for name in ("bc", "bc_floor"))
    distance = (f"{10 * row[name]:.4f}" for name in ("bd", "bd_floor"))
    return [row["model"], *percent, *coefficient, *distance, f"{row['nll']:.4f} ± {row['nll_error']:.4f}"]


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, first column to the left."""
    lines = ["| " + " | ".join(header) + " |", "|---" + "|---:" * (len(header) - 1) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])
