"""Benchmarks: cells are computed once and kept, settings are searched, timing is in turn, rivals stand the right way round."""

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from typer.testing import CliRunner

from benchmarks import ablations as benchmark_ablations
from benchmarks import named
from benchmarks import needle as benchmark_needle
from benchmarks import paper as benchmark_paper
from benchmarks import rivals as benchmark_rivals
from benchmarks import sabotage as benchmark_sabotage
from benchmarks import scenes as benchmark_scenes
from benchmarks.defocus import defocused_scene
from benchmarks.external import _cut, _oriented, _padded, astra_sirt, missing
from benchmarks.network import fit_network
from benchmarks.rivals import Effort, best_cutoff, curves, fitted, own_sirt, summary, table, unfinished
from benchmarks.scenes import Results, in_turn, make_scene, plain
from benchmarks.search import Best, best, best_fit
from noiseflow import Gaussian
from noiseflow.runs.ownership import is_own
from recon.commands import benchmark as command
from recon.commands.benchmark import benchmark
from recon.joint.joint import JointReconstructor
from recon.metrics.comparison import project
from recon.series.tilt_series import Volume

TINY = {"tilts": "-60:60:12"}


def test_what_is_kept_is_not_computed_again(tmp_path):
    path, calls = tmp_path / "r.json", []

    def compute():
        calls.append(1)
        return {"value": np.float32(0.123456789), "bad": float("nan")}

    first = Results(path, "test").cell("a", compute)
    again = Results(path, "test").cell("a", compute)
    assert first == again == json.loads(path.read_text())["cells"]["a"]
    assert len(calls) == 1
    assert first["value"] == 0.12346
    assert first["bad"] is None


def test_results_of_other_files_are_taken_with_their_machines(tmp_path):
    paths = [tmp_path / name for name in ("one.json", "two.json")]
    for path, machine in zip(paths, ("A", "B"), strict=True):
        cells = {"a": {"x": machine, "machine": 0}, machine: {"x": machine, "machine": 0}}
        path.write_text(json.dumps({"benchmark": "test", "machines": [machine], "cells": cells}))
    results = Results(paths[0], "test")
    results.take(paths[1])
    results.take(paths[1])
    kept = json.loads(paths[0].read_text())
    assert {key: (cell["x"], kept["machines"][cell["machine"]]) for key, cell in kept["cells"].items()} == {
        "A": ("A", "A"),
        "a": ("B", "B"),
        "B": ("B", "B"),
    }
    (tmp_path / "three.json").write_text(paths[1].read_text().replace('"B"', '"A"').replace('["A"]', '["C"]'))
    results.take(tmp_path / "three.json")
    assert results.content["machines"] == ["C", "B"]
    with pytest.raises(ValueError, match="another benchmark"):
        Results(tmp_path / "r.json", "other").take(paths[1])
    with pytest.raises(ValueError, match="no such file"):
        results.take(tmp_path / "none.json")


def test_a_run_that_stops_keeps_the_cells_before(tmp_path):
    results = Results(tmp_path / "r.json", "test")
    results.cell("a", lambda: {"x": 1})
    with pytest.raises(KeyboardInterrupt):
        results.cell("b", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert set(Results(tmp_path / "r.json", "test").cells) == {"a"}


@pytest.mark.parametrize("text", ["{", '{"benchmark": "other", "cells": {}}'])
def test_files_of_something_else_are_refused(tmp_path, text):
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(ValueError, match="remove it"):
        Results(tmp_path / "r.json", "test")


def test_functions_are_timed_in_turn():
    order = []
    found = in_turn([lambda: order.append("a"), lambda: order.append("b") or "last"], repeats=3)
    assert order == ["a", "b"] * 3
    assert found[1][1] == "last"
    assert all(seconds >= 0 for seconds, _ in found)


def test_scene_errors_vanish_for_the_truth_only():
    scene = make_scene(16, **TINY)
    assert scene.errors(scene.truth)["mse raw"] == 0
    assert scene.projection_errors(scene.truth)["2d mse min-max"] == 0
    assert scene.errors(np.zeros_like(scene.truth))["mse raw"] > 0.001
    assert not set(scene.test_angles) & set(scene.noisy.tilt_angles)


def test_searched_cutoff_is_the_best_of_those_tried():
    found = best_cutoff(make_scene(16, **TINY), "hann")
    assert found["tried"][found["cutoff"]] == max(found["tried"].values())


def test_curves_have_the_median_seconds_of_their_repeats(tmp_path):
    results = Results(tmp_path / "r.json", "rivals")
    for repeat, seconds in enumerate((3.0, 1.0, 2.0)):
        point = {"setting": "s", "seconds": seconds, "psnr affine": 20.0, "psnr raw": 19.0, "mse affine": 0.01}
        results.cell(f"16/curve {repeat}/m", lambda p=point: {"points": [p]})
    assert summary(results, 16)["m"][0]["seconds"] == 2.0
    assert table(summary(results, 16))[1][0][:3] == ("m", "s", "20.00")


def test_every_rival_is_ready_at_its_searched_setting(tmp_path, monkeypatch):
    small = JointReconstructor(noise_model=Gaussian, num_steps=3, slab=4)
    monkeypatch.setattr(benchmark_rivals, "reconstructors", lambda scene: {"L2 + TV": small})
    scene, effort = make_scene(16, **TINY), Effort(steps=(3,), weights=(0.2,), refine=0, repeats=1)
    results = Results(tmp_path / "r.json", "rivals")
    ready = curves(scene, results, "16", effort)
    assert {"SIRT", "WBP hann", "L2 + TV", "joint", "joint, default settings", "joint, voxels"} <= set(ready)
    assert results.cells["16/search/L2 + TV"]["weight"] == 0.2
    points = list(ready["L2 + TV"]())
    assert [setting for setting, _, _ in points] == ["3 steps"]
    assert points[0][2].shape == scene.truth.shape


@pytest.mark.skipif(missing("astra"), reason="the ASTRA toolbox is not installed")
def test_both_sirts_agree():
    scene = make_scene(16, **TINY)
    ours = {setting: volume for setting, _, volume in own_sirt(scene)}
    theirs = {setting: volume for setting, _, volume in astra_sirt(scene.noisy, scene.grid, (4, 16))}
    for setting, volume in theirs.items():
        assert np.corrcoef(volume.ravel(), ours[setting].ravel())[0, 1] > 0.995


def test_a_curve_that_was_cut_short_is_not_ranked():
    def curve(*settings):
        return [
            {"setting": each, "seconds": 1.0, "psnr raw": 9.0, "psnr affine": 9.0, "mse affine": 0.1}
            for each in settings
        ]

    found = {"short": curve("1 of 9 steps", "4 of 9 steps"), "whole": curve("4 of 9 steps", "9 of 9 steps"), "none": []}
    assert [row[0] for row in table(found)[1]] == ["whole"]
    assert [unfinished(points) for points in found.values()] == ["4 of 9 steps", "", ""]
    legend = benchmark_rivals.draw(found, "a title").axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["short, unfinished: 4 of 9 steps", "whole"]


def test_a_fit_with_default_settings_is_left_its_number_of_steps():
    scene, asked = SimpleNamespace(noisy=None), []

    @dataclass(frozen=True)
    class Fit:
        num_steps: int = 5

        def __call__(self, _):
            asked.append(self.num_steps)
            return SimpleNamespace(volume=Volume(np.zeros((2, 2, 2), np.float32)))

    assert [setting for setting, _, _ in fitted(scene, Fit(), (3, None))] == ["3 steps", "default settings"]
    assert asked == [3, None]


def test_volumes_of_other_programs_are_turned_the_right_way():
    volume = np.random.default_rng(0).random((5, 6, 7))
    turned = volume.transpose(2, 0, 1)[:, ::-1]
    np.testing.assert_array_equal(_oriented(turned, volume), volume)


def test_command_refuses_what_it_does_not_know(tmp_path):
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(benchmark)
    for arguments, words in (
        (["magic"], "choose from rivals"),
        (["--repeats", "0"], "at least 1"),
        (["sabotage", "--method", "magic"], "choose from auto"),
        (["needle", "--method", "l2"], "only for the benchmark sabotage"),
    ):
        result = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
        assert isinstance(result.exception, ValueError)
        assert words in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_command_writes_results_and_a_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_rivals, "QUICK", Effort(steps=(2,), weights=(0.2,), refine=0, repeats=1))
    monkeypatch.setattr(benchmark_rivals, "reconstructors", lambda scene: {})
    monkeypatch.setattr(benchmark_rivals, "JointReconstructor", lambda **options: None)
    monkeypatch.setattr(benchmark_rivals, "fitted", lambda scene, reconstructor, steps: iter(()))
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(benchmark)
    result = CliRunner().invoke(app, ["--quick", "--size", "16", "--out", str(tmp_path), "--json"])
    found = json.loads(result.stdout.splitlines()[-1])["rivals"]
    assert found["machines"][0]["versions"]["torch"]
    assert set(found["curves"]) >= {"SIRT", "WBP ramp"}
    assert len(list(tmp_path.glob("*.png"))) == 1


def test_sabotage_keeps_the_results_of_every_method_apart(tmp_path, monkeypatch):
    methods = []
    monkeypatch.setattr(benchmark_sabotage, "run", lambda results, line, *, method, **_: methods.append(method))
    monkeypatch.setattr(benchmark_sabotage, "table", lambda cells: (("spoilt by",), []))
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(benchmark)
    paths = set()
    for arguments in ([], ["--method", "l2"], ["--quick"]):
        result = CliRunner().invoke(app, ["sabotage", *arguments, "--size", "16", "--out", str(tmp_path), "--json"])
        paths.add(json.loads(result.stdout.splitlines()[-1])["sabotage"]["results"])
    assert methods == ["sirt", "l2", "sirt"]
    assert len(paths) == 3


def test_every_way_spoils_one_series_and_half_of_them_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_sabotage, "_cell", lambda results, line, key, compute: line(key))
    lines = []
    options = {"size": 16, "method": "sirt", "seed": 0, "quick": False}
    benchmark_sabotage.run(Results(tmp_path / "r.json", "test"), lines.append, **options)
    spoilt = [line.split("/")[1] for line in lines if line.startswith("spoilt/")]
    ways = benchmark_sabotage.WAYS
    assert sorted(spoilt) == sorted(ways)
    assert sum(line.startswith("good/") for line in lines) >= 50
    assert len(benchmark_sabotage.kept(ways)) == (len(ways) + 1) // 2
    assert benchmark_sabotage.kept(reversed(list(ways))) == benchmark_sabotage.kept(ways)


def test_plain_values_are_json():
    assert plain({"a": (np.float64(1 / 3), np.arange(2))}) == {"a": [0.33333, [0, 1]]}


def test_cells_are_computed_anew_where_that_is_asked_for(tmp_path):
    results = Results(tmp_path / "r.json", "test")
    for key in ("a/joint", "b/wbp"):
        results.cell(key, lambda: {"x": 1})
    results.forget("joint")
    assert results.cell("a/joint", lambda: {"x": 2})["x"] == 2
    assert results.cell("b/wbp", lambda: {"x": 2})["x"] == 1
    assert results.cells["a/joint"]["machine"] == 0
    assert results.content["machines"][0]["cores"] >= 1


def test_the_best_candidate_is_found_and_says_where_it_lies():
    found = best(((str(value), np.full(3, value)) for value in (1, 3, 2)), lambda volume: float(volume.sum()))
    assert (found.setting, found.volume[0], found.at_an_end) == ("3", 3, False)
    assert found.tried == {"1": 3.0, "3": 9.0, "2": 6.0}
    with pytest.raises(ValueError, match="no candidates"):
        best([], np.sum)


def test_published_errors_agree_with_their_decibels():
    for psnr_2d, mse_2d, dssim, psnr, mse in benchmark_paper.PUBLISHED.values():
        assert -10 * np.log10(mse_2d / 100) == pytest.approx(psnr_2d, abs=0.2)
        assert -10 * np.log10(mse / 100) == pytest.approx(psnr, abs=0.02)
        assert dssim < 5


class Perfect:
    """A reconstructor that knows the answer."""

    def __init__(self, **options):
        self.scene = make_scene(16, **TINY)

    def __call__(self, tilt_series, grid=None):
        volume = Volume(self.scene.truth * np.float32(0.9), None)
        return SimpleNamespace(volume=volume, weight=0.2)


def test_paper_table_has_every_method(tmp_path, monkeypatch):
    scene, results = make_scene(16, **TINY), Results(tmp_path / "r.json", "paper-table")
    monkeypatch.setattr(benchmark_paper, "best_fit", lambda *_, **__: Best("weight 0.5", scene.truth * 0.9, {}))
    monkeypatch.setattr(benchmark_paper, "denoised", lambda series, name: series)
    monkeypatch.setattr(benchmark_scenes, "JointReconstructor", Perfect)
    monkeypatch.setattr(benchmark_paper, "_trained", lambda scene_, name: Best("any", scene.truth * 0.8, {}))
    benchmark_paper.run(scene, results, lambda text: None)
    header, rows = benchmark_paper.table(results.cells)
    assert [row[0] for row in rows] == list(benchmark_paper.METHODS)
    assert all(len(row) == len(header) for row in rows)
    assert results.cells["joint"]["psnr affine"] > 60 > results.cells["WBP"]["psnr affine"]


def test_left_out_tilts_are_predicted_with_the_gain_that_suits_the_given_ones():
    scene = make_scene(16, **TINY)
    given = replace(scene.noisy, images=2.5 * project(scene.truth, scene.noisy.tilt_angles) + 0.4, mode="linear")
    predicted = benchmark_needle.predict(given, scene.truth, scene.test_angles)
    np.testing.assert_allclose(predicted, 2.5 * project(scene.truth, scene.test_angles) + 0.4, atol=1e-4)


def test_a_better_prediction_is_more_likely():
    generator = np.random.default_rng(0)
    signal = generator.random((2, 24, 24)).astype(np.float32)
    observed = signal + 0.1 * generator.standard_normal(signal.shape).astype(np.float32)
    good, bad = (benchmark_needle.held_out_nll(each, observed) for each in (signal, np.roll(signal, 1, axis=2)))
    assert good == pytest.approx(np.log(0.1 * np.sqrt(2 * np.pi * np.e)), abs=0.05)
    assert bad > good + 0.3


def test_real_series_is_split_without_loss():
    series = benchmark_needle.load()
    for noise in benchmark_needle.NOISES:
        for gap in benchmark_needle.GAPS:
            parts = benchmark_needle.split(series, noise, gap, seed=0)
            assert parts.given.num_tilts + parts.left_out.num_tilts == series.num_tilts
            assert not set(parts.given.tilt_angles) & set(parts.left_out.tilt_angles)
    assert parts.target.max() <= 10.0001
    assert 0.4 < float(np.std(parts.left_out.images - parts.target)) < 3.5


def test_every_ablation_is_named_once_and_runs(tmp_path, monkeypatch):
    scene = make_scene(16, **TINY)
    made = [variant for group in benchmark_ablations.GROUPS for variant in group(scene)]
    names = [(variant.group, variant.name) for variant in made]
    assert len(set(names)) == len(names)
    results = Results(tmp_path / "r.json", "ablations")
    monkeypatch.setattr(benchmark_scenes, "JointReconstructor", Perfect)
    chosen = {("field", "voxels, L2, no TV"), ("parts", "clipping ignored"), ("denoiser, then WBP", "wiener")}
    chosen |= {("defocus", "blurred by depth, modelled by depth"), ("skipping of vacuum", "off")}
    benchmark_ablations.fill([v for v in made if (v.group, v.name) in chosen], results, lambda text: None)
    header, rows = benchmark_ablations.table(results.cells)
    assert {row[:2] for row in rows} == chosen
    assert all(len(row) == len(header) for row in rows)


def test_defocus_blurs_a_scene_and_nothing_else():
    scene = make_scene(24, phantom="shells", noise="clipped", tilts="-60:60:20")
    same, blurred = defocused_scene(scene, 0.0), defocused_scene(scene, 0.2)
    np.testing.assert_allclose(same.clean.images, scene.clean.images, atol=1e-5)
    np.testing.assert_allclose(same.noisy.images, scene.noisy.images, atol=1e-5)
    roughness = [np.abs(np.diff(each.clean.images, axis=1)).mean() for each in (same, blurred)]
    assert roughness[1] < 0.9 * roughness[0]
    np.testing.assert_array_equal(blurred.truth, scene.truth)


def test_network_on_the_lattice_learns():
    scene = make_scene(16, **TINY)
    few, more = (fit_network(replace(scene, noisy=scene.clean), width=16, num_steps=steps) for steps in (2, 60))
    errors = [
        np.mean((project(volume, scene.test_angles) - project(scene.truth, scene.test_angles)) ** 2)
        for volume in (few, more)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_weight_of_the_highest_score_is_bracketed():
    def score(volume):
        return -(np.log(float(volume.mean()) / 0.9) ** 2)

    @dataclass(frozen=True)
    class Constant:
        weight: float = 0.0

        def __call__(self, series, grid):
            return SimpleNamespace(volume=Volume(np.full((2, 2, 2), self.weight), None))

    found = best_fit(None, None, Constant(), score)
    assert found.volume[0, 0, 0] == pytest.approx(0.9, rel=0.05)
    assert not found.at_an_end


@pytest.mark.parametrize(("shape", "side"), [((9, 4, 4), 10), ((3, 4, 4), 4), ((3, 5, 4), 6), ((9, 5, 5), 9)])
def test_padded_images_are_square_and_cut_out_again(shape, side):
    images = np.random.default_rng(0).random(shape)
    padded = _padded(images)
    assert padded.shape == (shape[0], side, side)
    assert padded.sum() == pytest.approx(images.sum())
    centre = (side - shape[2]) // 2
    np.testing.assert_array_equal(padded[:, (side - shape[1]) // 2][:, centre : centre + shape[2]], images[:, 0])
    if shape[1] == shape[2]:
        cube = np.broadcast_to(padded[0], (side, side, side))
        np.testing.assert_array_equal(_cut(cube, shape[1])[0], images[0])


def test_figures_of_others_are_refused_before_the_work(tmp_path, monkeypatch):
    other, calls = tmp_path / "rivals-48-clipped-shells-0--60_60_4-quick.png", []
    monkeypatch.setitem(named.BENCHMARKS, "rivals", lambda options: calls.append(options) or {})
    other.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="--overwrite"):
        benchmark(["rivals"], quick=True, out=tmp_path)
    assert not calls
    benchmark(["rivals"], quick=True, out=tmp_path, overwrite=True)
    assert calls[0].overwrite
    assert other.read_bytes() == b"mine"


def test_figures_made_here_are_known(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_rivals, "summary", lambda *_: {})
    monkeypatch.setattr(benchmark_rivals, "table", lambda *_: ((), []))
    monkeypatch.setattr(benchmark_rivals, "draw", lambda *_: Figure())
    output = SimpleNamespace(table=lambda *_: None, line=lambda *_: None)
    options = named.Options(16, TINY, benchmark_rivals.QUICK, "", tmp_path, output)
    results = SimpleNamespace(path=tmp_path / "rivals.json", content={"machines": []})
    assert is_own(named._shown(options, results)["figure"])


def test_an_installed_package_names_the_source_tree() -> None:
    with pytest.raises(FileNotFoundError, match="source tree"):
        command.command(None)()
