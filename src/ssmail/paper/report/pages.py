"""Write a report as one self-contained HTML page, and as Markdown that links to the saved figures."""

import os
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ssmail import __version__
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError
from ssmail.paper.claims import Verdict
from ssmail.paper.report.contents import Report, samples_of
from ssmail.paper.report.drawing import Drawn
from ssmail.plots import formatting
from ssmail.store import RunRow

MARKDOWN, HTML = "report.md", "report.html"
TEMPLATES = Path(__file__).with_name("templates")
INLINE = (".png", ".svg")  # formats that Markdown viewers display
SIGNS = {Verdict.SUPPORTED: "✓", Verdict.CONTRADICTED: "✗", Verdict.INCONCLUSIVE: "?"}


def write(report: Report, folder: Path) -> list[Path]:
    """Write report.md and report.html into the folder atomically, and return their paths.

    Raises InputError for a folder that cannot be written.
    """
    pages = {MARKDOWN: markdown(report, folder), HTML: html(report)}
    paths = [folder / name for name in pages]
    try:
        for path, text in zip(paths, pages.values(), strict=True):
            with atomic_write(path) as partial:
                partial.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}; choose another folder.") from None
    return paths


def html(report: Report) -> str:
    """Render the HTML page, with style, script and figures inline."""
    parts = {name: Markup((TEMPLATES / f"report.{name}").read_text(encoding="utf-8")) for name in ("css", "js")}
    return _environment(autoescape=True).get_template("report.html.j2").render(report=report, **parts)


def markdown(report: Report, folder: Path) -> str:
    """Render the report as Markdown, without whole specs. Paths of figures are relative to `folder`."""

    def path(drawn: Drawn) -> str:
        return _relative(drawn, folder)

    return _environment(autoescape=False).get_template("report.md.j2").render(report=report, path=path)


def _environment(autoescape: bool) -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=autoescape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "number": formatting.number,
        "measured": formatting.measured,
        "duration": formatting.duration,
        "spans": formatting.spans,
        "base64": lambda data: b64encode(data).decode("ascii"),
        "sign": SIGNS.__getitem__,
        "cell": lambda text: str(text).replace("|", "\\|").replace("\n", " "),
        "code": formatting.short_code,
        "distinct": lambda values: sorted({value for value in values if value is not None}),
        "samples": samples_of,
        "differences": _differences,
        "whole": _whole,
    }
    environment.globals |= {"version": __version__, "counted": formatting.counted}
    return environment


def _differences(values: Mapping[str, Any]) -> str:
    """Format the keys in which a spec differs from others: "beta 0.15, epochs 40"."""
    return ", ".join(f"{key.rpartition('.')[2]} {formatting.setting(value)}" for key, value in values.items())


def _whole(run: RunRow) -> str:
    """Format the run's spec as YAML."""
    return str(yaml.safe_dump(run.spec, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True))


def _relative(drawn: Drawn, folder: Path) -> str:
    """The link from the folder to the figure's picture, or to its first file when Markdown can display none."""
    pictures = [file for file in drawn.files if file.suffix in INLINE] or list(drawn.files)
    return quote(Path(os.path.relpath(pictures[0], folder)).as_posix())
