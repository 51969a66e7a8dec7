"""`ssmail config`: the values of a spec and where each comes from, the reference of the keys, an experiments.yaml."""

import os
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ssmail.config.names import DEFAULT_ENVIRONMENT, DEFAULT_METHOD
from ssmail.errors import InputError, printable, shortened
from ssmail_cli import completion, options
from ssmail_cli.command_group import Commands
from ssmail_cli.output import Format, chosen_format, note, print_rows, say, write_json

app = typer.Typer(
    cls=Commands, help="Show the settings of a run and what they mean, or write your own.", rich_markup_mode=None
)

SHOWN = {"key": "key", "value": "value", "layer": "from"}
REFERENCE = {name: name for name in ("key", "type", "unit", "range", "default", "meaning")}
Keys = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[KEY]...",
        help="Sections or keys, such as sac or sac.gamma; default all.",
        autocompletion=completion.keys,
    ),
]


@app.command()
def show(
    keys: Keys = None,
    method: Annotated[str, options.method_option("The method")] = DEFAULT_METHOD,
    environment: Annotated[str, options.environment_option("The environment")] = DEFAULT_ENVIRONMENT,
    profile: options.TrainingProfile = "quick",
    settings: options.Settings = None,
    as_json: options.Json = False,
    form: options.Output = None,
) -> None:
    """Show every value of the spec that `ssmail train` would train, and the layer that it comes from.

    A layer is a place in experiments.yaml, such as defaults or environments.letters, or --set. Which experiments.yaml
    is in use stands on stderr.
    """
    from ssmail.config.experiments import explained_spec
    from ssmail.config.experiments_file import load_experiments
    from ssmail.config.names import flatten
    from ssmail.config.strict_yaml import inline

    spec, sources = explained_spec(method, environment, profile, settings or [])
    file, values = load_experiments().path, flatten(spec.model_dump(mode="json"))
    rows = [
        {"key": key, "value": values[key], "layer": source.removesuffix(f" of {file.name}")}
        for key in _chosen(keys)
        if key in values and (source := sources.get(key))
    ]
    kind = chosen_format(as_json, form)
    if kind is Format.JSON:
        about = {"method": method, "environment": environment, "profile": profile, "spec_hash": spec.hash()}
        write_json({"file": file, **about, "values": rows}, None)
        return
    note(f"{method} on {environment}, profile {profile}, spec {spec.hash()[:8]}; values of {file}")
    print_rows([{**row, "value": inline(row["value"])} for row in rows], SHOWN, kind)


@app.command("keys")
def keys_command(keys: Keys = None, as_json: options.Json = False, form: options.Output = None) -> None:
    """Explain the keys of the spec: type, unit, range, default and meaning.

    A range is an interval: in [0, 1) is 0, and 1 is not. The default is that of the layer `defaults`; `ssmail config
    show` has the values of a method, an environment and a profile.
    """
    from ssmail.config.keys import reference
    from ssmail.config.strict_yaml import inline

    chosen = set(_chosen(keys))
    found = [key for section in reference() for key in section.keys if key.name in chosen]
    kind = chosen_format(as_json, form)
    rows = [
        {
            "key": key.name,
            "type": key.kind,
            "unit": key.unit,
            "range": key.range,
            "default": key.default if kind is Format.JSON else inline(key.default),
            "meaning": key.meaning,
        }
        for key in found
    ]
    if kind is Format.TABLE:
        say(*_paragraphs(rows))
    else:
        print_rows(rows, REFERENCE, kind)


@app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="[FILE]", help="The file to write.")] = Path("experiments.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")] = False,
) -> None:
    """Write an experiments.yaml of your own: a copy of the one that is shipped with ssmail.

    Every command uses the experiments.yaml of the current folder, and says so on stderr; SSMAIL_EXPERIMENTS=FILE names
    another one.
    """
    from ssmail.config.experiments_file import FILE_NAME, shipped_file
    from ssmail.data.atomic_file import atomic_write

    if os.path.lexists(file) and not force:
        raise InputError(f"{file} exists already; give --force to overwrite it, or another name.")
    try:
        with atomic_write(file, overwrite=force) as partial:
            partial.write_bytes(shipped_file().read_bytes())
    except OSError as error:
        raise InputError(f"{file} cannot be written: {error.strerror}; give another path.") from None
    say(file)
    here = file.resolve() == Path.cwd() / FILE_NAME
    note("commands in this folder use it now" if here else f"use it with SSMAIL_EXPERIMENTS={file}")


def _chosen(keys: Sequence[str] | None) -> list[str]:
    """Return the keys that can be set, of these sections if any are given. Raises InputError for an unknown one."""
    from ssmail.config.spec import nearest_key, spec_keys

    known = spec_keys()
    for name in keys or ():
        if name not in known:
            raise InputError(f"unknown key '{shortened(name, 60)}'; {nearest_key(name)}")
    return [
        key
        for key, is_section in known.items()
        if not is_section and (not keys or any(f"{key}.".startswith(f"{name}.") for name in keys))
    ]


def _paragraphs(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of a reference for people: a key with what its values are, and below it what it means."""
    width = shutil.get_terminal_size().columns
    for row in rows:
        about = (row["type"], row["range"], row["unit"], f"default {row['default']}")
        yield f"{row['key']}: {', '.join(filter(None, about))}"
        yield from textwrap.wrap(printable(row["meaning"]), width, initial_indent="  ", subsequent_indent="  ")
