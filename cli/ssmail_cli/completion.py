"""What the shell completes when Tab is pressed: names, keys of the spec, and what a database holds.

The shell waits for it, so nothing here imports torch, pydantic or sqlalchemy: the database is read with sqlite3, within
a fraction of a second. What cannot be read completes nothing.
"""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperArgument, TyperOption

from ssmail.config.names import ENVIRONMENTS, METHODS, flatten
from ssmail.errors import InputError
from ssmail.paper.results import CLAIMS, FIGURES

if TYPE_CHECKING:
    from ssmail.config.experiments_file import Experiments

ASKED = "_SSMAIL_COMPLETE"
"""The environment variable with which a shell asks for completions instead of running a command."""
MOST_IDS = 200
_SECONDS = 0.2  # for a query
_NAME = re.compile(r"[\w./-]+", re.ASCII)  # what is completed: a shell evaluates no character of it


def take_values_as_they_are() -> None:
    """Let Typer convert no value in this process: it imports pydantic for that, and Tab would have to wait."""
    for kind in (TyperArgument, TyperOption):
        kind.process_value = lambda _, ctx, value: value  # type: ignore[assignment]


def methods() -> list[str]:
    """Return the methods."""
    return list(METHODS)


def environments() -> list[str]:
    """Return the environments."""
    return list(ENVIRONMENTS)


def figures() -> list[str]:
    """Return the figures of the paper by both of their names."""
    return list(FIGURES)


def claims() -> list[str]:
    """Return the claims of the paper."""
    return [f"C{number}" for number, _ in enumerate(CLAIMS, start=1)]


def profiles() -> list[str]:
    """Return the profiles of experiments.yaml."""
    return _of_experiments(lambda experiments: experiments.profiles)


def ablations() -> list[str]:
    """Return the ablations of experiments.yaml."""
    return _of_experiments(lambda experiments: experiments.ablations)


def controls() -> list[str]:
    """Return the controls of experiments.yaml, and the word for all of them."""
    return [*_of_experiments(lambda experiments: experiments.controls), "all"]


def controls_and_words() -> list[str]:
    """Return what `ssmail control` takes: the controls, and the words for all of them and for their table."""
    return [*controls(), "list"]


def keys() -> list[str]:
    """Return the keys of the spec: ["data.path", ...]."""
    return _of_experiments(lambda experiments: flatten(experiments.defaults))


def settings() -> list[str]:
    """Return the keys of the spec, as --set takes them: ["data.path=", ...]."""
    return [f"{key}=" for key in keys()]


def varied() -> list[str]:
    """Return what `ssmail ablate` can vary: the ablations of experiments.yaml, and the keys of the spec."""
    return [*ablations(), *keys()]


def columns(ctx: typer.Context) -> list[str]:
    """Return what runs can be ordered by: the stored metrics, and the keys of the spec."""
    return [*metrics(ctx), *keys()]


def run_ids(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the ids of stored runs that begin so, by their first digits, the newest first."""
    if re.fullmatch("[0-9a-f]*", incomplete) is None:
        return []
    digits = max(8, len(incomplete))
    select = f"SELECT DISTINCT substr(id, 1, {digits}) FROM run WHERE id LIKE ? || '%' ORDER BY started DESC LIMIT ?"
    return _query(ctx, "run", select, incomplete, MOST_IDS)


def metrics(ctx: typer.Context) -> list[str]:
    """Return the names of the stored metrics."""
    return _query(ctx, "metric_latest", "SELECT DISTINCT name FROM metric_latest ORDER BY name")


def _of_experiments(names: "Callable[[Experiments], Iterable[str]]") -> list[str]:
    from ssmail.config.experiments_file import load_experiments

    try:
        return [name for name in names(load_experiments()) if _NAME.fullmatch(name)]
    except InputError:
        return []


def _query(ctx: typer.Context, table: str, select: str, *values: str | int) -> list[str]:
    """Return the names that a query of one column and `table` finds in the database of the command line."""
    import sqlite3
    import time
    from contextlib import closing
    from urllib.parse import quote

    deadline = time.monotonic() + _SECONDS
    try:
        where = Path(_database(ctx)).expanduser().absolute()
        with closing(sqlite3.connect(f"file:{quote(str(where))}?mode=ro", uri=True, timeout=_SECONDS)) as connection:
            connection.set_progress_handler(lambda: time.monotonic() > deadline, 1000)
            connection.execute("PRAGMA trusted_schema = OFF")
            kinds = connection.execute("SELECT type FROM sqlite_master WHERE name = ?", (table,)).fetchall()
            if kinds != [("table",)]:  # a view would compute what its author likes
                return []
            return [name for (name,) in connection.execute(select, values) if _NAME.fullmatch(str(name))]
    except (sqlite3.Error, OSError, RuntimeError, ValueError):
        return []


def _database(ctx: typer.Context) -> str:
    """Return the value of --db or its default; in `ssmail plot` the option belongs to the group."""
    context: Any = ctx
    while context is not None and not context.params.get("db"):
        context = context.parent
    return str(context.params["db"]) if context else ""
