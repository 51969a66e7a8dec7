"""Sphinx extension that writes the reference pages when a build starts: docs/reference/, which git ignores.

`commands.md` is read off the Typer application, `keys.md` off the sections of the spec, and `api/` has a page for each
package of ssmail, filled by autodoc. So none of them can disagree with the code.
"""

import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from sphinx.application import Sphinx

import ssmail
from ssmail.config import keys
from ssmail.config.strict_yaml import inline
from ssmail_cli.main import app as application

FOLDER = Path(__file__).parent / "reference"
LEFT_OUT = "ssmail.store.migrations"  # Alembic's scripts run when they are imported


def _write(path: Path, text: str) -> None:
    """Write a page, unless it has this text already: Sphinx then reads only what has changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


def _escape(text: str) -> str:
    """Protect what Markdown would interpret, outside of code spans."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([<>*_|\[\]~])", r"\\\1", part) for part in parts)


def _cell(text: str) -> str:
    return " ".join(_escape(text).split()).replace("|", r"\|").replace(r"\\|", r"\|")


def _command(command: Any, context: Any) -> Iterator[str]:
    """Yield the lines of one command: usage, help and a table of its options; then those of its subcommands."""
    level = "#" * (1 + context.command_path.count(" "))
    if level != "#":
        yield from (f"{level} {context.command_path}", "")
    usage = command.get_usage(context).removeprefix("Usage: ")
    yield from ("```text", " ".join(usage.split()), "```", "")
    for paragraph in (command.help or "").split("\n\n"):
        yield from (_escape(" ".join(paragraph.split())), "")
    records = [record for parameter in command.get_params(context) if (record := parameter.get_help_record(context))]
    if records:
        yield from ("| option | meaning |", "|---|---|")
        for names, meaning in records:
            code = names.replace("|", "\\|")
            yield f"| `{code}` | {_cell(meaning)} |"
        yield ""
    for name, child in getattr(command, "commands", {}).items():
        yield from _command(child, type(context)(child, info_name=name, parent=context))
    if command.epilog:
        yield from (_escape(command.epilog), "")


def _commands() -> str:
    command = typer.main.get_command(application)
    context = command.make_context("ssmail", ["train"], resilient_parsing=True)
    return "\n".join(["# Commands", "", *_command(command, context)])


KEYS = """\
# Settings

Every key of a spec. Set one with `--set sac.gamma=0.9`, vary one with `ssmail ablate sac.gamma --values 0.8,0.9`, or
change a default in an experiments.yaml of your own (`ssmail config init`). `ssmail config show` prints the values of a
method, environment and profile, and the layer that each comes from; `ssmail config keys` prints this page.

A range is an interval: in [0, 1) is 0, and 1 is not. The default is that of the layer `defaults` of experiments.yaml.
Method, environment and profile are not keys: they are given with `--method`, `--env` and `--profile`.
"""


def _keys() -> str:
    lines = [KEYS]
    for section in keys.reference():
        lines += [f"## {section.name}", "", _escape(section.meaning), ""]
        lines += [f"Only of {', '.join(section.used_by)}.", ""] if section.used_by else []
        lines += ["| key | type | unit | range | default | meaning |", "|---|---|---|---|---|---|"]
        for key in section.keys:
            cells = map(_cell, (key.kind, key.unit or "", key.range or ""))
            default = f"`{inline(key.default)}`"
            lines.append(f"| {' | '.join((f'`{key.name}`', *cells, default, _cell(key.meaning)))} |")
        lines.append("")
    return "\n".join(lines)


def _modules(package: str) -> list[str]:
    """Return the public modules of a package and its subpackages, itself first."""
    path = importlib.import_module(package).__path__
    found = [name for _, name, _ in pkgutil.walk_packages(path, f"{package}.") if not name.startswith(LEFT_OUT)]
    return [package, *sorted(name for name in found if not any(part.startswith("_") for part in name.split(".")))]


def _page(package: str) -> str:
    """Return the page of a package: its own docstring, then a section for each module."""
    _, *modules = _modules(package)
    lines = [package, "=" * len(package), "", f".. automodule:: {package}", ""]
    for module in modules:
        lines += [module, "-" * len(module), "", f".. automodule:: {module}", ""]
    return "\n".join(lines)


def _write_pages(app: Sphinx) -> None:
    _write(FOLDER / "commands.md", _commands())
    _write(FOLDER / "keys.md", _keys())
    packages = sorted(name for _, name, is_package in pkgutil.iter_modules(ssmail.__path__, "ssmail.") if is_package)
    for package in packages:
        _write(FOLDER / "api" / f"{package}.rst", _page(package))
    index = ["API reference", "=============", "", ".. toctree::", "   :maxdepth: 1", ""]
    index += [f"   {package}" for package in packages]
    index += ["", "ssmail.errors", "-------------", "", ".. automodule:: ssmail.errors", ""]
    _write(FOLDER / "api" / "index.rst", "\n".join(index))


def _read_docstring(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Turn a docstring's plain text with `code` into reStructuredText, where backticks differ."""
    parts = re.split(r"(`[^`]+`)", "\n".join(lines))
    text = "".join(
        f"`{part}`" if part.startswith("`") else re.sub(r"([*|\\]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts
    )
    lines[:] = text.split("\n")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hooks with Sphinx."""
    app.connect("builder-inited", _write_pages)
    app.connect("autodoc-process-docstring", _read_docstring)
    return {"parallel_read_safe": True}
