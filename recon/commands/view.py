"""The command `noiseflow view`: a report, or a volume with its error bars, in the browser of this machine."""

import os
import tomllib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

import typer

from noiseflow.commands.console import JsonOption, Output
from noiseflow.runs.outputs import options_file
from noiseflow.runs.ownership import is_own


def view(
    output: Annotated[Path, typer.Argument(help="Report (folder or page), or volume, shown in its report, if any.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0 for any free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
    json: JsonOption = False,
) -> None:
    """Show a report, or a volume and its error bars, in the browser. Only this machine can connect; Ctrl-C ends it."""
    import webbrowser

    out, page = Output(json), _page(output)

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            known = self.path == "/" and self.headers.get("Host") == f"127.0.0.1:{server.server_port}"
            content = page if known else b"not found"
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Requests are not printed."""

    with ThreadingHTTPServer(("127.0.0.1", port), Page) as server:
        address = f"http://127.0.0.1:{server.server_port}/"
        out.line(f"{output}: {address} (Ctrl-C ends it)")
        out.result({"address": address})
        if browser:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            out.line("ended")


def _page(output: Path) -> bytes:
    """The page of a report, or a new page of a volume without one. Raises FileNotFoundError, ValueError if it is neither, or
    cannot be read.
    """
    from noiseflow import io

    if output.is_dir() and output.suffix != ".zarr":
        found = [page for name in ("index.html", "report.html") if (page := output / name).is_file()]
        if not found:
            raise FileNotFoundError(f"{output} holds no report; name a folder of --report, or a volume")
        return found[0].read_bytes()
    if output.suffix == ".html":
        return output.read_bytes()
    own = _report_of(output)
    if own is not None:
        return own.read_bytes()
    from noiseflow.report import Report
    from recon.commands.measure import read_error_bars
    from recon.report.page import add_volume
    from recon.series.tilt_series import Volume

    volume = Volume.read(output)
    io.require_finite(volume.attenuation, output)
    bars = read_error_bars(output, volume)
    report = Report(output.name, "A volume without its report: --report also shows tilts, residuals and the verdict.")
    parts = {"Volume": volume} | ({} if bars is None else bars.parts)
    for title, part in parts.items():
        add_volume(report, part, "per voxel", title.capitalize())
    return report.render().encode()


def _report_of(volume: Path) -> Path | None:
    """The page of the run that wrote a volume; None if there is none, or the volume is newer."""
    file = options_file(volume)
    run = tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() and is_own(file) else {}
    if not isinstance(report := run.get("report"), str):
        return None
    page = volume.parent / os.path.relpath(report, Path(run.get("out", volume)).parent) / "index.html"
    return page if page.is_file() and page.stat().st_mtime >= volume.stat().st_mtime else None
