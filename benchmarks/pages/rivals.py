"""The results pages of the methods of reconstruction, from the JSON that `noiseflow benchmark` has written.

    noiseflow benchmark rivals slow-rivals --size 64 --budget 60 --out docs/benchmarks/results     # run time against error
    noiseflow benchmark rivals --size 96 --repeats 1 --out docs/benchmarks/results                 # the same, larger
    noiseflow benchmark paper-table --size 32 --phantom cell --out docs/benchmarks/results         # the paper's main table
    noiseflow benchmark ablations --size 32 --out docs/benchmarks/results                          # one part at a time
    noiseflow benchmark needle --out docs/benchmarks/results                                       # a real series
    python -m benchmarks.pages.rivals                                                               # the pages

Interrupted runs resume; `--again joint` computes the rows of the joint fits anew. Pages tell what is measured and
what is not.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import ablations as benchmark_ablations
from benchmarks import needle as benchmark_needle
from benchmarks import paper as benchmark_paper
from benchmarks import rivals as benchmark_rivals
from benchmarks import search as benchmark_search
from benchmarks.pages import FOLDER, dots
from benchmarks.provenance import measured_on
from benchmarks.scenes import EMPTY, Results
from noiseflow.io import atomic_path

RESULTS = FOLDER / "results"
Content = dict[str, Any]


def main() -> None:
    """Write all pages, and the figures of run time against error."""
    for name, page in PAGES.items():
        with atomic_path(FOLDER / name) as partial:
            partial.write_text(page(RESULTS), encoding="utf-8")
    for size in _sizes(RESULTS):
        with atomic_path(FOLDER / _figure(size)) as partial:
            title = f"clipped noise, {size}³, 79 tilts"
            picture = benchmark_rivals.draw(_curves(RESULTS, size), title)
            picture.savefig(partial, format="png", dpi=110, facecolor="white")
    for _, content in _named_files(RESULTS, "needle-"):
        dots.save(FOLDER / "needle.png", _needle_panels(content["cells"]), columns=2)
    for name, content in _named_files(RESULTS, "paper-table-"):
        dots.save(FOLDER / _picture(name), _paper_panels(content["cells"]), columns=2)
    for name, content in _named_files(RESULTS, "ablations-"):
        dots.save(FOLDER / _picture(name), _ablation_panels(content["cells"]), columns=2)


def run_time(folder: Path) -> str:
    """The page of run time against error."""
    sizes = _sizes(folder)
    parts = [
        "# Run time against error",
        *(
            _wall_time(size) + f"\n\n*{size}³, one point for each setting; the other sizes are below.*"
            for size in sizes[:1]
        ),
        "Each point of the pictures is a complete run from tilt series to volume, set-up included; errors are computed "
        "outside the timed part. PSNR is over the range of the truth, either raw or after an affine match: the best gain and "
        "offset, which back-projection needs.",
        _defaults(folder),
        "The tables below show each method at its best setting, found from the truth outside the timed part, which no user can "
        "do. The joint fit chooses its own weight and noise model within its time; only its number of steps is the best of "
        "three. The oracle, a line in the figures, is the same fit with the true noise at its best weight. ASTRA's SIRT runs "
        "on the CPU, slice by slice; its GPU algorithms were not measured. To measure one size, run:\n\n"
        "```sh\nnoiseflow benchmark rivals slow-rivals --size 64 --out docs/benchmarks/results\n"
        "python -m benchmarks.pages.rivals\n```",
    ]
    for size in sizes:
        files = [*_files(folder, f"rivals-{size}-"), *_files(folder, f"slow-rivals-{size}-")]
        curves = _curves(folder, size)
        header, rows = benchmark_rivals.table(curves)
        repeats = {key.split("/")[1] for file in files[:1] for key in file["cells"] if "/curve" in key}
        loads = [cell["load"] for file in files for cell in file["cells"].values()]
        parts += [
            f"## {size}³",
            "" if size == sizes[0] else _wall_time(size),
            _table(header, rows),
            _unfinished(curves),
            f"{_runs(len(repeats))} Load of the machine before each run: {min(loads):.1f} to {max(loads):.1f}.",
            measured_on(files),
        ]
    missing = [f"{size}³" for size in (64, 96, 128) if size not in sizes]
    gaps = [f"- {', '.join(missing)} on a CPU: not measured yet."] if missing else []
    gaps += [
        "- 256³ and 512³: only the default settings.",
        "- The method of the paper needs 400 000 steps. Its curves show the first hour on one of the two cores, with other "
        "work on the second one: 55 to 95 steps. They are drawn as unfinished and are not ranked.",
        "- quantem's implicit reconstruction runs with its own settings, except for poses, which are known here, and images "
        "padded to the 79 pixels a side that it needs. Its smallest step is one pass over the data; the first pass had not "
        "ended after ten minutes on two cores, nor after 24 minutes on one.",
    ]
    return _joined([*parts, "## Not measured, or not to the end", "\n".join(gaps)])


def _wall_time(size: int) -> str:
    return f"![PSNR over wall time for every method at {size}³]({_figure(size)})"


def _defaults(folder: Path) -> str:
    """What a user gets: everything chosen by the program, from the rows of speed of the joint page."""
    path = folder / "joint.json"
    content: Content = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"cells": {}}
    cells = {name: cell for name, cell in content["cells"].items() if name.startswith("speed/chosen-")}
    if not cells:
        return ""
    rows = [
        (cell["scene"], method, f"{cell[f'{method}, volume PSNR (dB)']:.2f}", f"{cell[method]:.1f}")
        for _, cell in sorted(cells.items(), key=lambda item: int(item[0].rsplit("-", 1)[1]))
        for method in ("joint", "least squares")
    ]
    machines = [content["machines"][number] for number in sorted({cell["machine"] for cell in cells.values()})]
    return "\n\n".join(
        (
            "## With default settings",
            "`noiseflow reconstruct` with `--method joint` and `--method l2`, without other options: the program chooses weight, "
            "noise model and number of steps. Times are medians of three runs in turn, with nothing else running.",
            _table(("scene", "method", "PSNR, raw (dB)", "seconds"), rows),
            "```sh\npython -m benchmarks.pages.joint speed --row chosen-64 --row chosen-96 --row chosen-256 --again\n```",
            measured_on([{"cells": cells, "machines": machines}]),
            "## At the best setting of each method",
        )
    )


def _unfinished(curves: Content) -> str:
    """The curves whose time ran out, which the table leaves out."""
    lines = [
        f"{name}: {stopped} in {points[-1]['seconds']:.0f} s, {points[-1]['psnr affine']:.2f} dB"
        for name, points in curves.items()
        if (stopped := benchmark_rivals.unfinished(points))
    ]
    return f"Not finished, and not ranked: {'; '.join(lines)}." if lines else ""


def paper_table(folder: Path) -> str:
    """The page of the paper's main table."""
    parts = [
        "# The main table of Kniesel et al. (CVPR 2022), made again",
        "This page compares all seven methods on a scene like the paper's synthetic one: shells with virions among them, "
        "noise that grows with the signal, clipped, 79 tilts. The 2D columns are measured on 20 clean projections at angles "
        "between the tilts. As in the paper, errors are min–max scaled, MSE is in units of 0.01, DSSIM in units of 0.1 and "
        "PSNR in dB; columns marked *published* are the paper's figures, and columns marked *affine* are matched by gain and "
        "offset instead.",
    ]
    for name, content in _named_files(folder, "paper-table-"):
        header, rows = benchmark_paper.table(content["cells"])
        known = content["cells"].keys() | benchmark_paper.NOT_RUN
        absent = [method for method in benchmark_paper.METHODS if method not in known]
        picture = f"![Min–max PSNR of projections and volume, measured here and published]({_picture(name)})"
        parts += [f"## {_scene(name)}", picture, _table(header, rows), _standing(content["cells"]), _absent(absent)]
        parts += [_command("paper-table", name), measured_on([content])]
    not_run = "\n".join(["## Not run", "", *(f"- *{name}*: {why}." for name, why in benchmark_paper.NOT_RUN.items())])
    return _joined([*parts, _nothing(folder, "paper-table", " --size 32 --phantom cell"), not_run, _PAPER_DIFFERENCES])


_PAPER_DIFFERENCES = (
    "## What differs from the paper\n\n"
    "- **Scene**: the size (the paper has 1000³), the random numbers, and the noise, whose model the paper does not publish.\n"
    "- **Methods**: our L2 and joint fits use the sum of grids with this library's regulariser, in rows that end in *network* "
    "the sine network of `--field network` with the same regulariser, in rows that end in *network of the paper* its nine layers "
    "without a regulariser, trained as by `--preset kniesel2022`. WBP and SIRT are those of this library, not of IMOD, at their "
    "best window, cutoff and number of iterations. The supervised fit uses a flow that was fitted to clean and noisy images.\n"
    "- **Settings**: those of all but the joint fits were searched with the truth, in fits of "
    f"{benchmark_search.STEPS} steps ({benchmark_paper.CLEAN_STEPS} for clean images). Rows with a sine network take 0.7 of "
    "the weight that was best with grids.\n"
    "- **A correction**: the printed table exchanges MSE and DSSIM in its last five rows (its PSNR is that of the other "
    "column); here they are put right."
)


def _standing(cells: Content) -> str:
    """Who is best in 3D and in 2D, affinely matched, of those without the truth."""
    blind = {name: cell for name, cell in cells.items() if not name.startswith(("L2, clean images", "oracle"))}
    if not blind:
        return ""
    lines = []
    for figure, words in (
        ("psnr affine", "volume"),
        ("2d psnr affine", "projections"),
        ("psnr min-max", "volume, min–max"),
    ):
        ranked = sorted(blind, key=lambda name: -blind[name][figure])
        scores = "; ".join(f"{name} {blind[name][figure]:.2f}" for name in ranked)
        lines.append(f"- PSNR of the {words}, in dB, best first: {scores}.")
    return "\n".join(lines)


def ablations(folder: Path) -> str:
    """The page of the ablations."""
    parts = [
        "# What each part is worth",
        "Each table changes one part of the joint fit. PSNR, in dB, is that of the volume and of 20 clean projections at "
        "angles between the tilts.",
    ]
    for name, content in _named_files(folder, "ablations-"):
        cells = content["cells"]
        header, rows = benchmark_ablations.table(cells)
        parts += [
            f"## {_scene(name)}",
            f"![PSNR of volume and projections, one panel for each table below]({_picture(name)})",
        ]
        for group in dict.fromkeys(row[0] for row in rows):
            parts += [
                f"### {group[0].upper() + group[1:]}",
                _table(header[1:], _with_empty([row[1:] for row in rows if row[0] == group], rows)),
            ]
            parts.append(_remark(group, cells))
        parts += [_command("ablations", name), measured_on([content])]
    gaps = "- Networks wider than those in the table, and networks at the paper's 400 000 iterations."
    settings = (
        "## Settings\n\n"
        "- Least squares, L1 and the oracle take the best weight that a bracketing search finds, in fits of "
        f"{benchmark_search.STEPS} steps; fields take as many steps.\n"
        f"- *Parts* and *flow layers* fit a radial flow at the same weight, {benchmark_ablations.WEIGHT:g}.\n"
        "- The networks have the paper's nine layers. They are evaluated on the whole voxel grid for all tilts at once, with "
        "300 steps of Adam and no total variation. Without a GPU, their scene has 32³ voxels: on one of 64³, the widest would "
        "take hours."
    )
    return _joined([*parts, _nothing(folder, "ablations", " --size 64"), settings, "## Not measured", gaps])


def _with_empty(group: list[tuple[str, ...]], rows: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The rows of a group after that of the empty volume, which is the same for all groups of one scene."""
    own = [row for row in group if row[0] == EMPTY]
    return [*(own or [row[1:] for row in rows if row[1] == EMPTY][:1]), *(row for row in group if row[0] != EMPTY)]


def _remark(group: str, cells: Content) -> str:
    """What a group says in numbers."""
    found = {key.split("/", 1)[1]: cell for key, cell in cells.items() if key.startswith(f"{group}/")}
    if group == "parts" and {"as it is", "likelihood not tabulated"} <= set(found):
        ratio = found["likelihood not tabulated"]["seconds"] / found["as it is"]["seconds"]
        return f"Without the tabulated likelihood the fit took {ratio:.1f} times as long (one run each)."
    if group == "network":
        return f"Scene: {next(iter(found.values()))['scene']}."
    joint = cells.get("likelihood/learnt noise (joint)")
    if group == "weight" and joint is not None:
        best = max(found, key=lambda name: found[name]["psnr raw"])
        return (
            f"The held-out likelihood chose {joint['setting']}: {joint['psnr raw']:.2f} dB. The best weight tried, {best}, "
            f"gives {found[best]['psnr raw']:.2f} dB."
        )
    return ""


def needle(folder: Path) -> str:
    """The page of the real series."""
    parts = [
        "# A real tilt series with tilts left out",
        "![PSNR of the left-out tilts for every method, in four panels by noise and left-out tilts, best first](needle.png)",
        "Each method reconstructs the needle, a HAADF-STEM series of 91 tilts of 64 × 64 pixels that ships with the library "
        "(`noiseflow/data/tilt_needle`), from some of its tilts and predicts the others.",
        "- **PSNR** compares the prediction with the measured left-out tilts, over their range, in dB. Their own noise and "
        "misalignment limit it.\n"
        "- **NLL** is the negative log-likelihood of the left-out tilts, which are as noisy as the given ones, in nats per "
        "pixel; lower is better. It is computed under a Gaussian whose width depends on the signal, fitted to the other half "
        "of these tilts, in the same way for all methods.\n"
        "- PSNR weighs bright pixels and NLL dark ones, so that hardly any method leads by both; {doc}`../architecture` "
        "reports two trials.\n"
        "- One gain and offset, matched on the given tilts, are applied to all predictions: by least squares for PSNR, by "
        "likelihood for NLL.\n"
        "- No method has an offset below the lowest pixel value. When offsets were free (commit 1027279), least squares with "
        "total variation predicted every fifth tilt 1.1 dB better (41.05 dB) over an offset below zero, and 1.1 nats per pixel "
        "worse.\n"
        "- Joint fits have the seed 0. With the seeds 1 to 5 the default has 35.69 to 35.93 and 32.82 to 33.06 dB in the tables "
        "with 10 counts, and voxels in the second table have 35.17 and 35.14 dB with the seeds 1 and 2: with the seed 0 their "
        "volume has 15 % more mass, which the offset balances.\n"
        "- In two of the tables noise is added: Poisson counts, with the stated number in the brightest pixel, and read noise "
        "of half a count.\n"
        f"- Least squares and L1 take {benchmark_search.STEPS} steps, so that they converge. The settings of all but the joint "
        "fits are those with the best PSNR on the left-out tilts, which favours them.",
    ]
    for name, content in _named_files(folder, "needle-"):
        cells = content["cells"]
        header, rows = benchmark_needle.table(cells)
        for noise, left_out in dict.fromkeys(row[:2] for row in rows):
            chosen = [row[2:] for row in rows if row[:2] == (noise, left_out)]
            parts += [f"## {_noise(noise).capitalize()}, {_tilts(left_out)} left out", _table(header[2:], chosen)]
            absent = [method for method in _METHODS if method not in [row[0] for row in chosen]]
            likeliest = min(chosen, key=lambda row: float(row[2]))
            parts += [f"Best by PSNR: {chosen[0][0]}; by NLL: {likeliest[0]}.", _absent(absent)]
        parts += [_command("needle", name), measured_on([content])]
    return _joined([*parts, _nothing(folder, "needle")])


def _noise(noise: str) -> str:
    return "no added noise" if noise == "as measured" else noise


def _tilts(left_out: str) -> str:
    return "every fifth tilt" if left_out == "every fifth" else f"tilts {left_out}"


def _needle_panels(cells: Content) -> list[dots.Panel]:
    """PSNR of every method, best first, for each noise and gap."""
    panels: dict[str, dict[str, float]] = {}
    for noise, left_out, method, psnr, *_ in benchmark_needle.table(cells)[1]:
        panels.setdefault(f"{_noise(noise)}, {_tilts(left_out)} left out", {})[method] = float(psnr)
    return [(title, "PSNR of the left-out tilts (dB)", {"": values}) for title, values in panels.items()]


def _paper_panels(cells: Content) -> list[dots.Panel]:
    """Min–max PSNR as measured here and as published, of projections and volume."""
    panels = []
    for words, key, place in (("projections", "2d psnr min-max", 0), ("volume", "psnr min-max", 3)):
        ranked = sorted(cells, key=lambda name: -cells[name][key])
        ours = {name: float(cells[name][key]) for name in ranked}
        published = {
            name: benchmark_paper.PUBLISHED[name][place] for name in ranked if name in benchmark_paper.PUBLISHED
        }
        panels.append((words, "PSNR, min–max scaled (dB)", {"measured here": ours, "published": published}))
    return panels


def _ablation_panels(cells: Content) -> list[dots.Panel]:
    """PSNR of volume and projections, one panel a table."""
    panels: dict[str, dict[str, dict[str, float]]] = {}
    for group, what, volume, _, projections, *_ in benchmark_ablations.table(cells)[1]:
        series = panels.setdefault(group, {"volume": {}, "projections": {}})
        series["volume"][what], series["projections"][what] = float(volume), float(projections)
    return [(group, "PSNR (dB)", series) for group, series in panels.items()]


def _picture(name: str) -> str:
    return f"{name.removesuffix('-full').replace('-', '_')}.png"


_METHODS = tuple(benchmark_needle.methods(benchmark_needle.load(), lambda volume: 0.0))

PAGES: dict[str, Callable[[Path], str]] = {
    "run_time.md": run_time,
    "paper_table.md": paper_table,
    "ablations.md": ablations,
    "needle.md": needle,
}


def _named_files(folder: Path, start: str) -> list[tuple[str, Content]]:
    paths = sorted(folder.glob(f"{start}*-full.json"))
    return [(path.stem, json.loads(path.read_text(encoding="utf-8"))) for path in paths]


def _files(folder: Path, start: str) -> list[Content]:
    return [content for _, content in _named_files(folder, start)]


def _sizes(folder: Path) -> list[int]:
    return sorted({int(name.split("-")[1]) for name, _ in _named_files(folder, "rivals-")})


def _curves(folder: Path, size: int) -> dict[str, list[dict[str, Any]]]:
    curves: dict[str, list[dict[str, Any]]] = {}
    for title in ("rivals", "slow-rivals"):
        for path in sorted(folder.glob(f"{title}-{size}-*-full.json")):
            curves |= benchmark_rivals.summary(Results(path, title), size)
    return curves


def _figure(size: int) -> str:
    return f"run_time_{size}.png"


def _scene(name: str) -> str:
    size, noise, phantom, seed = name.rsplit("-", 5)[1:5]
    return f"{phantom}, {noise} noise, {size}³, seed {seed}"


def _command(benchmark: str, name: str) -> str:
    words = f"noiseflow benchmark {benchmark}"
    if benchmark != "needle":
        size, noise, phantom, seed = name.rsplit("-", 5)[1:5]
        words += f" --size {size} --noise {noise} --phantom {phantom} --seed {seed}"
    return f"```sh\n{words} --out docs/benchmarks/results\npython -m benchmarks.pages.rivals\n```"


def _absent(names: Sequence[str]) -> str:
    return f"Not measured yet: {', '.join(names)}." if names else ""


def _runs(count: int) -> str:
    return "One run of each." if count == 1 else f"{count} repeats in turn."


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _nothing(folder: Path, benchmark: str, options: str = "") -> str:
    """That a benchmark has no results, with the command that makes them; nothing where it has."""
    if _files(folder, f"{benchmark}-"):
        return ""
    return f"Not measured yet: `noiseflow benchmark {benchmark}{options} --out docs/benchmarks/results` does it."


def _joined(parts: Iterable[str]) -> str:
    return "\n\n".join(part for part in parts if part) + "\n"


if __name__ == "__main__":
    main()
