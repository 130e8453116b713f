"""Would the tests notice? Changes one operator or number of the mathematical core at a time, and runs the tests nearest to it.

    python -m tests.mutation --number 60 --seed 0 [--only recon/projection] [--results FILE.json]

Every mutant runs in a forked process that has imported torch and pytest but nothing of ours, so that an import hook can put the
changed module in place; the files stay as they are. A mutant that takes five times as long as the tests do counts as killed.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib.util
import json
import os
import random
import resource
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

import hypothesis.strategies  # noqa: F401  what takes long to import, once for all mutants
import mpmath  # noqa: F401
import numpy  # noqa: F401
import pytest
import safetensors.torch  # noqa: F401
import scipy.optimize
import scipy.stats  # noqa: F401
import skimage.metrics  # noqa: F401
import torch
import typer.testing  # noqa: F401

from tests.mutation_left_out import LEFT_OUT

ROOT = Path(__file__).parents[1]
TARGETS = {
    "noiseflow/distributions/numerics/monotone_maps.py": ["noiseflow/distributions/test_transforms.py"],
    "noiseflow/distributions/numerics/normal.py": ["noiseflow/distributions/test_normal.py"],
    "noiseflow/distributions/noise_distribution.py": ["noiseflow/distributions/test_law.py"],
    "noiseflow/distributions/wrappers/digitised.py": [
        "noiseflow/distributions/test_digitised.py",
        "noiseflow/models/test_digitisation.py",
    ],
    "noiseflow/fitting/pixel_split.py": ["noiseflow/fitting/test_pixels.py"],
    "noiseflow/fitting/observation_table.py": [
        "noiseflow/fitting/test_table_edges.py",
        "noiseflow/distributions/test_tabulated.py",
    ],
    "noiseflow/models/digitised.py": [
        "noiseflow/models/test_digitised_model.py",
        "noiseflow/models/test_digitisation.py",
    ],
    "noiseflow/metrics/evaluation.py": ["noiseflow/metrics/test_metrics.py"],
    "noiseflow/io/mrc.py": ["noiseflow/io/test_mrc.py", "noiseflow/io/test_tilt_axis.py"],
    "noiseflow/io/angles.py": [
        "noiseflow/io/test_alignment.py",
        "recon/series/test_tilt_series.py",
        "test_series_files.py",
    ],
    "recon/projection/projector.py": ["recon/projection/test_projector.py"],
    "recon/projection/base.py": ["recon/projection/test_sparse.py", "recon/projection/test_projector.py"],
    "recon/projection/classical.py": ["recon/projection/test_wbp.py", "recon/methods/test_classical.py"],
    "recon/metrics/metrics.py": ["recon/metrics/test_shells.py"],
    "recon/fields/regularisers/second_order.py": ["recon/fields/test_vacuum.py", "recon/fields/test_fields.py"],
    "recon/fields/occupancy.py": ["recon/fields/test_occupancy.py", "recon/fields/test_vacuum.py"],
    "calibration/detector/log_posterior.py": ["calibration/detector/test_log_posterior.py"],
    "noiseflow/runs/run_folder.py": ["noiseflow/runs/test_states.py", "recon/test_resume.py"],
}
"""File → the tests nearest to it, nearest first."""
PAIRS: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
PATIENCE, LEAST_SECONDS = 5, 20


@dataclass(frozen=True)
class Mutant:
    """One change: the file, its line, what was there, what is, and the whole changed source."""

    file: str
    line: int
    before: str
    after: str
    source: str


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant."""

    file: str
    line: int
    before: str
    after: str
    killed: bool


class _Spots(ast.NodeVisitor):
    """The nodes of a module that can be changed; messages, annotations and docstrings are not."""

    def __init__(self) -> None:
        self.found: list[ast.AST] = []

    def visit_Raise(self, node: ast.Raise) -> None:
        """Messages and kinds of errors are left alone."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        """Annotations are left alone."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Texts are left alone."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (node.args, *node.body):
            self.visit(part)

    def generic_visit(self, node: ast.AST) -> None:
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
        operator = isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in PAIRS
        comparison = isinstance(node, ast.Compare) and type(node.ops[0]) in PAIRS
        sign = isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not))
        if number or operator or comparison or sign:
            self.found.append(node)
        super().generic_visit(node)


def number_of_mutants(file: str) -> int:
    """How many changes a file allows."""
    return len(_spots(ast.parse((ROOT / file).read_text(encoding="utf-8"))))


def left_out(file: str) -> dict[int, tuple[str, str, str]]:
    """The entry of `LEFT_OUT` for each change that is not tried, by its index."""
    text = (ROOT / file).read_text(encoding="utf-8")
    lines, found = text.splitlines(), {}
    for index, node in enumerate(_spots(ast.parse(text))):
        for entry in LEFT_OUT.get(file, []):
            part, what, _ = entry
            same = isinstance(node, ast.Constant) if what == "numbers" else ast.unparse(node) == what
            if same and part in lines[node.lineno - 1]:
                found[index] = entry
    return found


def mutant(file: str, index: int) -> Mutant:
    """One change of a file."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    node = _spots(tree)[index]
    before = ast.unparse(node)
    _change(tree, node)
    after = ast.unparse(node if not isinstance(node, ast.UnaryOp) else node.operand)
    return Mutant(file, node.lineno, before, after, ast.unparse(ast.fix_missing_locations(tree)))


def _spots(tree: ast.AST) -> list[Any]:
    spots = _Spots()
    spots.visit(tree)
    return spots.found


def _change(tree: ast.AST, node: Any) -> None:
    if isinstance(node, ast.Constant):
        node.value = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + (node.value == 0)
    elif isinstance(node, ast.Compare):
        node.ops[0] = PAIRS[type(node.ops[0])]()
    elif isinstance(node, ast.UnaryOp):
        _Replace(node, node.operand).visit(tree)
    else:
        node.op = PAIRS[type(node.op)]()


class _Replace(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> Any:
        return self.new if node is self.old else self.generic_visit(node)


class _Loader(SourceFileLoader):
    def __init__(self, name: str, path: str, source: str) -> None:
        super().__init__(name, path)
        self.source = source

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source, self.path, "exec")


class _Finder:
    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant
        self.name = mutant.file.removesuffix(".py").replace("/", ".")

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != self.name:
            return None
        file = str(ROOT / self.mutant.file)
        return importlib.util.spec_from_file_location(name, file, loader=_Loader(name, file, self.mutant.source))


def survives(tests: list[str], mutant: Mutant | None, seconds: float) -> bool:
    """Whether the tests pass, in a process of their own with so much processor time."""
    process = os.fork()
    if process == 0:
        code = 3
        try:
            os.setpgrp()
            resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            if mutant is not None:
                sys.meta_path.insert(0, _Finder(mutant))  # type: ignore[arg-type]
            torch.set_num_threads(1)
            os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = (
                "1"  # loading the plugins takes longer than most of the tests
            )
            code = int(
                pytest.main(["-x", "-q", "-p", "no:cacheprovider", *(str(ROOT / "tests" / test) for test in tests)])
            )
        finally:
            os._exit(code)
    _, status = os.waitpid(process, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)  # whatever a test left running
    return status == 0


def judge(chosen: list[tuple[str, int]]) -> Iterator[Outcome]:
    """Run every mutant, a file and an index, against its tests, after making sure that these pass as they are."""
    patience: dict[str, float] = {}
    for file, index in chosen:
        tests, changed = TARGETS[file], mutant(file, index)
        if file not in patience:
            before = _children_seconds()
            if not survives(tests, None, 600):
                raise SystemExit(f"the tests of {file} fail as they are")
            patience[file] = max(LEAST_SECONDS, PATIENCE * (_children_seconds() - before))
        killed = not survives(tests, changed, patience[file])
        yield Outcome(file, changed.line, changed.before, changed.after, killed)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(verdicts: list[Outcome]) -> str:
    """Markdown: a row for each file, then each survivor."""
    rows = ["| file | mutants | killed |", "|---|---|---|"]
    for file in TARGETS:
        of_file = [verdict for verdict in verdicts if verdict.file == file]
        if of_file:
            rows.append(f"| `{file}` | {len(of_file)} | {sum(verdict.killed for verdict in of_file)} |")
    killed = sum(verdict.killed for verdict in verdicts)
    rows.append(f"| all | {len(verdicts)} | {killed} ({killed / max(1, len(verdicts)):.0%}) |")
    survivors = [verdict for verdict in verdicts if not verdict.killed]
    return "\n".join([*rows, "", *(f"- `{v.file}:{v.line}`: `{v.before}` → `{v.after}`" for v in survivors)])


def main() -> None:
    """Sample, run and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=60, help="how many mutants, drawn at random; 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[""], help="files whose path contains one of these")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="start no mutant after so much time")
    parser.add_argument("--results", type=Path, help="JSON file to write")
    asked = parser.parse_args()
    files = [file for file in TARGETS if any(part in file for part in asked.only)]
    every = [(file, index) for file in files for index in range(number_of_mutants(file)) if index not in left_out(file)]
    chosen = random.Random(asked.seed).sample(every, min(asked.number, len(every))) if asked.number else every
    started, verdicts = time.monotonic(), []
    for verdict in judge(chosen):
        verdicts.append(verdict)
        mark = "killed" if verdict.killed else "SURVIVED"
        print(f"{mark:9}{verdict.file}:{verdict.line}: {verdict.before} -> {verdict.after}", flush=True)
        if time.monotonic() - started > asked.seconds:
            break
    print(f"\n{len(verdicts)} of {len(every)} mutants\n\n{table(verdicts)}")
    if asked.results is not None:
        kept = {"every": len(every), "seed": asked.seed, "verdicts": [asdict(verdict) for verdict in verdicts]}
        asked.results.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
