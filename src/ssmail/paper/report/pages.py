"""Write a report as one self-contained HTML page, and as Markdown that links to the saved figures."""

import os
import re
from base64 import b64encode
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ssmail import __version__
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, printable
from ssmail.paper.claims import Verdict
from ssmail.paper.report.contents import Report, samples_of
from ssmail.paper.report.drawing import Drawn
from ssmail.plots import formatting
from ssmail.store import RunRow, RunState
from ssmail.store.comparison import Comparison

MARKDOWN, HTML = "report.md", "report.html"
TEMPLATES = Path(__file__).with_name("templates")
INLINE = (".png", ".svg")  # formats that Markdown viewers display
SPECIAL = re.compile(r"[\\`*\[\]<>|~$]|&(?=[#\w])|(?<![^\W_])_|_(?![^\W_])")
"""What means something to Markdown in the middle of a line; a backslash before it takes that away."""
BLOCK = re.compile(r"^(\s*\d*)([-+=.)])(?=[\s=-]|$)|^(\s*)(#)")
"""What begins a list, a rule or a heading where it begins a line; a minus before a number is none."""
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
    """Render the HTML page, with style, script and figures inline. Every other text is made printable and escaped."""
    parts = {name: Markup((TEMPLATES / f"report.{name}").read_text(encoding="utf-8")) for name in ("css", "js")}
    environment = _environment(autoescape=True, finalize=_for_html)
    return environment.get_template("report.html.j2").render(report=report, **parts)


def markdown(report: Report, folder: Path) -> str:
    """Render the report as Markdown, without whole specs. Paths of figures are relative to `folder`.

    Every text that the template inserts is escaped, so none from a database is read as Markdown or HTML. Only a bare
    address may become a link to what it says, in viewers that look for those.
    """

    def path(drawn: Drawn) -> _Markdown:
        return _relative(drawn, folder)

    environment = _environment(autoescape=False, finalize=_for_markdown)
    return environment.get_template("report.md.j2").render(report=report, path=path)


class _Markdown(str):
    """A text that is Markdown already."""


def _for_html(value: Any) -> Any:
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _for_markdown(value: Any) -> Any:
    if not isinstance(value, str) or isinstance(value, _Markdown):
        return value
    escaped = SPECIAL.sub(r"\\\g<0>", printable(value))
    return BLOCK.sub(r"\1\3\\\2\4", escaped)


def _span(value: str) -> _Markdown:
    """Return the text as a code span, which can hold backticks too."""
    text = printable(value)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if len(fence) > 1 or not text.strip() else ""
    return _Markdown(f"{fence}{pad}{text}{pad}{fence}")


def _cell_span(value: str) -> _Markdown:
    """Return the text as a code span in a table, where a pipe ends the cell even in code."""
    return _Markdown(_span(value).replace("|", "\\|"))


def _environment(autoescape: bool, finalize: Callable[[Any], Any]) -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=autoescape,
        finalize=finalize,
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
        "span": _span,
        "cell_span": _cell_span,
        "code": formatting.short_code,
        "distinct": lambda values: sorted({value for value in values if value is not None}),
        "samples": samples_of,
        "differences": _differences,
        "whole": _whole,
        "mean": _mean,
        "seeds": _seeds,
    }
    environment.globals |= {"version": __version__, "counted": formatting.counted}
    return environment


def _differences(values: Mapping[str, Any]) -> str:
    """Format the keys in which a spec differs from others: "beta 0.15, epochs 40"."""
    return ", ".join(f"{key.rpartition('.')[2]} {formatting.setting(value)}" for key, value in values.items())


def _mean(item: Comparison) -> str:
    """Format the mean over the seeds, with the standard deviation: "0.0123 ± 0.0011"."""
    spread = f" ± {formatting.number(item.std, 2)}" if item.std is not None else ""
    return f"{formatting.number(item.mean)}{spread}"


def _seeds(item: Comparison) -> str:
    """Format the seeds, with the state of those that did not finish: "0-2, 3 diverged"."""
    ended = [seed for seed, state in item.states.items() if state is RunState.FINISHED]
    others = [f"{seed} {state}" for seed, state in item.states.items() if state is not RunState.FINISHED]
    return ", ".join([formatting.spans(ended)] * bool(ended) + others)


def _whole(run: RunRow) -> Markup:
    """Format the run's spec as YAML, for HTML."""
    text = str(yaml.safe_dump(run.spec, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True))
    return Markup("\n").join(map(printable, text.split("\n")))


def _relative(drawn: Drawn, folder: Path) -> _Markdown:
    """The link from the folder to the figure's picture, or to its first file when Markdown can display none."""
    pictures = [file for file in drawn.files if file.suffix in INLINE] or list(drawn.files)
    return _Markdown(quote(os.fsencode(Path(os.path.relpath(pictures[0], folder)).as_posix())))
