"""The command `noiseflow batch`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from noiseflow.commands.console import JsonOption, Output, OverwriteOption, output_file
from noiseflow.progress import progress_shown
from noiseflow.runs.outputs import Outputs

if TYPE_CHECKING:
    from recon.scale.many import Job, Row

_TABLES = frozenset({".csv", ".json"})


def batch(
    source: Annotated[Path, typer.Argument(help="Folder, or CSV table with columns tilts and maybe out and options.")],
    out: Annotated[Path, typer.Option("--out", "--output", "-o", help="Folder for the volumes.")],
    table: Annotated[Path | None, output_file("Table of verdicts; OUT/batch.csv.", _TABLES, "--table")] = None,
    noise_model: Annotated[Path | None, typer.Option(help="Calibrated noise model that all series share.")] = None,
    options: Annotated[str, typer.Option(help="Options of reconstruct for all, in quotes: '--method sirt'.")] = "",
    workers: Annotated[int, typer.Option(min=1, help="Number of series at a time, which share the cores.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler for the series.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Skip finished series; resume interrupted ones.")] = False,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
) -> None:
    """Reconstruct many tilt series, and write one table of verdicts and figures. A series that fails does not stop the others."""
    from recon.scale.blocks import client_of
    from recon.scale.many import finished, jobs_of, left_out, read_table, reconstruct_all, write_table

    output, table = Output(json), out / "batch.csv" if table is None else table
    with Outputs(source, noise_model, overwrite=overwrite) as outputs:
        outputs.folder(out, creates=True)
        outputs.file(table, suffixes=_TABLES)
        words = _shared_words(options, noise_model, resume=resume, overwrite=overwrite)
        jobs, skipped = jobs_of(source, out, words), left_out(source)
        if skipped:
            output.line(f"skipped (folders, or no tilt angles in or next to them): {', '.join(skipped)}")
        rows = finished(read_table(table), jobs) if resume else []
        known = {row["volume"] for row in rows}
        left = [job for job in jobs if str(job.out) not in known]
        if known:
            output.line(f"{len(known)} of {len(jobs)} series are already done")
        with client_of(None, scheduler) as client, progress_shown(json_mode=json) as progress:
            try:
                for done, row in enumerate(reconstruct_all(left, workers=workers, client=client), 1):
                    rows.append(row)
                    write_table(table, _in_order(rows, jobs))
                    name = Path(row["series"]).name
                    progress("series", done, max(1, len(left)), name)
                    error = f" failed: {row['error']}"
                    output.line(name + (f": {row['verdict']}. {row['reason']}" if row["status"] == "done" else error))
            except KeyboardInterrupt:
                done = sum(row["status"] == "done" for row in rows)
                raise KeyboardInterrupt(f"{done} of {len(jobs)} series are done; continue with --resume") from None
        write_table(table, rows := _in_order(rows, jobs))
    failed = [row for row in rows if row["status"] != "done"]
    output.line(f"{len(rows) - len(failed)} of {len(jobs)} series reconstructed; table: {table}")
    output.result({"table": table, "series": rows, "left_out": skipped})
    if failed:
        raise ValueError(f"{len(failed)} of {len(jobs)} series failed; reasons are in {table}; --resume tries again")


def _shared_words(options: str, noise_model: Path | None, *, resume: bool, overwrite: bool) -> list[str]:
    try:
        words = shlex.split(options)
    except ValueError as error:
        raise ValueError(f"--options {options}: {str(error).lower()}") from error
    if noise_model is not None:
        words += ["--noise-model", str(noise_model)]
    return words + ["--resume"] * resume + ["--overwrite"] * overwrite


def _in_order(rows: list[Row], jobs: list[Job]) -> list[Row]:
    places = {str(job.out): place for place, job in enumerate(jobs)}
    return sorted(rows, key=lambda row: places.get(row["volume"], len(places)))
