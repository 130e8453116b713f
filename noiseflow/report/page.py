"""The self-contained HTML page: text, tables, figures and interactive images that work offline, with light and dark themes."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import platform
import re
import shlex
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from noiseflow.installation import DISTRIBUTION, version_of
from noiseflow.io import atomic_path, check_output, files_of, output_folder
from noiseflow.report.charts import COLOURS, Chart, templates
from noiseflow.runs.outputs import invocation
from noiseflow.runs.ownership import signature

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from noiseflow.checks import Verdict


class Report:
    """A self-contained HTML page that is built part by part and works offline.

    Args:
        title: page title; all text is escaped.
        lead: a sentence below the title.
    """

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._parts: list[str] = []
        self._folded = False

    def _add(self, part: str, *values: Any) -> None:
        """Add a part from its macro in ``parts.html``."""
        self._parts.append(getattr(templates().get_template("parts.html").module, part)(*values))

    def heading(self, text: str, *, folded: bool = False) -> None:
        """Start a section; a folded one shows only its heading until the reader opens it."""
        self._parts, self._folded = [self._content()], folded
        self._add("heading", text, folded)

    def _content(self) -> str:
        return "".join(self._parts) + ("</details>" if self._folded else "")

    def columns(self, *columns: Callable[[], None]) -> None:
        """Add columns, which stand side by side on wide screens; each function adds the parts of one."""
        self._parts, self._folded = [self._content(), '<div class="columns">'], False
        for add in columns:
            self._parts.append("<div>")
            add()
            self._parts, self._folded = [self._content(), "</div>"], False
        self._parts.append("</div>")

    def text(self, text: str, *, kind: str = "") -> None:
        """Add a paragraph, of the style `kind`, such as ``command``; options are not broken across lines."""
        self._add("text", re.split(r"(\s+)", text), kind)

    def numbered(self, items: Sequence[str]) -> None:
        """Add a numbered list of sentences."""
        self._add("numbered", items)

    def facts(self, facts: Sequence[tuple[str, str]]) -> None:
        """Add the most important values, (name, value), as cards."""
        self._add("facts", facts)

    def table(
        self, header: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str = "", prose: bool = False
    ) -> None:
        """Add a table. The first column is left-aligned; with `prose` all columns are, and long cells wrap."""
        self._add("table", header, rows, caption, prose)

    def figure(self, figure: Figure, *, caption: str) -> None:
        """Add a matplotlib figure as PNG on white. Use it for images, and `charts` for curves."""
        stream = io.BytesIO()
        engine = figure.get_layout_engine()
        if engine is not None:  # otherwise `savefig` would draw everything once more for the layout
            figure.set_dpi(110)
            engine.execute(figure)
            figure.set_layout_engine("none")
        margins = "tight" if engine is None else None
        figure.savefig(stream, format="png", dpi=110, facecolor="white", bbox_inches=margins)
        self._add("figure", base64.b64encode(stream.getvalue()).decode(), caption)

    def charts(self, charts: Sequence[Chart], *, caption: str) -> None:
        """Add charts side by side, as many per row as fit; they follow the page theme."""
        self._add("charts", "".join(chart.svg() for chart in charts), caption)

    def widget(self, kind: str, data: dict[str, Any], *, caption: str) -> None:
        """Add an interactive view, ``volume`` or ``tilts``, with the data for its script in ``assets``."""
        stored = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        self._add("widget", kind, stored, caption)

    def include(self, path: str | Path) -> None:
        """Add the content of a saved report as a part of this one."""
        page = Path(path).read_text(encoding="utf-8")
        title = page.partition("<title>")[2].partition("</title>")[0]
        content = page.partition("<main>")[2].rpartition("</main>")[0]
        if not content:
            raise ValueError(f"{path} is not a noiseflow report and has no content to include")
        self._parts, self._folded = [self._content()], False
        self._add("included", title, content.replace("<h2>", "<h3>").replace("</h2>", "</h3>"))

    def render(self) -> str:
        """The page as text."""
        values = {"title": self.title, "lead": self.lead, "content": self._content(), "generator": signature()}
        text: str = templates().get_template("page.html").render(values)
        return text

    def save(self, path: str | Path) -> Path:
        """Write the page, in a folder that is created if necessary, and return its path."""
        path = Path(path)
        with output_folder(path.parent):
            check_output(path, suffixes=frozenset({".html"}))
            with atomic_path(path) as partial:
                partial.write_text(self.render(), encoding="utf-8")
        return path


_PACKAGES = (DISTRIBUTION, "torch", "numpy", "scipy")


def provenance(inputs: Sequence[str | Path] = (), *, seed: int | None = None) -> list[tuple[str, str]]:
    """Rows (name, value) with the information needed to reproduce a result.

    Args:
        inputs: input files and image folders; each is listed with its size and SHA-256.
    """
    called = invocation()
    rows = [("command", shlex.join(["noiseflow", *called.words]) if called is not None else "called from Python")]
    rows += [(f"input: {Path(path).name}", text) for path in inputs if (text := _checksum(path)) is not None]
    rows += [("seed", str(seed))] if seed is not None else []
    versions = (f"{package} {version_of(package) or '(not installed)'}" for package in _PACKAGES)
    rows.append(("versions", ", ".join([f"Python {platform.python_version()}", *versions])))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    rows.append(("written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")))
    return rows


def _checksum(path: str | Path) -> str | None:
    """Size and digest of a file, or of the concatenated images of a folder; None if it does not exist."""
    files = [file for file in files_of(path) if file.is_file()]
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            hashlib.file_digest(stream, lambda: digest)
    count = f"{len(files)} files, " if len(files) > 1 else ""
    size = sum(file.stat().st_size for file in files)
    return f"{count}{size:,} bytes, SHA-256 {digest.hexdigest()}" if files else None


_WORDS = {
    "good": "Good: no check found a fault.",
    "doubtful": "Doubtful: parts of the result may be wrong.",
    "bad": "Bad: do not use the result until you have corrected the first reason.",
}
_EFFECTS = (
    "The {shown} largest of {all} effects, with two standard errors. Right of the dashed line an effect exceeds its tolerance; "
    "it gives a reason if it is also significant."
)


def add_verdict(report: Report, verdict: Verdict, *, next_step: str = "", shown: int = 12) -> None:
    """Add heading, grade, reasons, the next step and effects of a verdict to a report.

    Args:
        next_step: what to do with a good result; the first remedy is shown for others.
        shown: largest number of effects in the chart.
    """
    report.heading("Verdict")
    report.text(_WORDS[verdict.grade], kind=verdict.grade)
    reasons = [f"{reason[0].upper()}{reason[1:]}." for reason in verdict.reasons]
    if len(reasons) > 1:
        report.numbered(reasons)
    elif reasons:
        report.text(reasons[0])
    good = next_step if verdict.grade == "good" else ""
    if advice := f"{verdict.findings[0].check.advice}." if verdict.findings else good:
        report.text(f"Next: {advice}")
    count = sum(bool(each.get("tolerance")) for each in verdict.evidence.values())
    if count:
        caption = _EFFECTS.format(shown=min(count, shown), all=count)
        report.charts([effects_chart(verdict, shown=shown)], caption=caption)


def effect_size(effect: dict[str, Any]) -> float:
    """The size of an effect in tolerances."""
    return float(abs(effect["value"] - effect["null"]) / effect["tolerance"])


def effects_chart(verdict: Verdict, *, shown: int = 12, most: float = 4.0) -> Chart:
    """The largest effects of a verdict with two standard errors, in their tolerances; those beyond `most` are drawn there."""
    every = [(name, each) for name, each in verdict.evidence.items() if each.get("tolerance")]
    effects = sorted(every, key=lambda pair: -effect_size(pair[1]))[:shown]
    chart = Chart("Effects and their tolerances", x="size of the effect, tolerances", width=5.6, height=3.2)
    places = np.arange(len(effects))[::-1]
    sizes = np.array([effect_size(each) for _, each in effects])
    errors = np.array([each["error"] / each["tolerance"] for _, each in effects])
    fired = np.array([each["cost"] > 1 for _, each in effects])
    for which, colour in ((~fired, COLOURS["accent"]), (fired, COLOURS["warm"])):
        size, error = (np.minimum(values, most)[which] for values in (sizes, 2 * errors))
        chart.plot(size, places[which], width=0, dots=2.5, error=error, across=True, colour=colour)
    chart.line(x=1.0)
    chart.ticks["y"] = list(zip(places.astype(float), (name for name, _ in effects), strict=True))
    chart.limits["x"] = -0.1, most + 0.2
    return chart
