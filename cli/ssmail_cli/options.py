"""Options that several commands share, and the store they name."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError, SsmailError, unknown_name
from ssmail_cli.display import Format

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store

DEFAULT_DATABASE = "results/ssmail.db"

Database = Annotated[
    str,
    typer.Option("--db", envvar="SSMAIL_DB", metavar="PATH|URL", help="The database: a file, or an SQLAlchemy URL."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON; NaN and infinities are text in it.")]
Output = Annotated[
    Format | None,
    typer.Option("--format", help="How to print.", show_default="a table on a terminal, else CSV"),
]
Method = Annotated[str | None, typer.Option("--method", help="Only runs of this method.")]
Environment = Annotated[str | None, typer.Option("--env", help="Only runs on this environment.")]
Profile = Annotated[str | None, typer.Option("--profile", help="Only runs of this profile.")]
State = Annotated[
    str | None,
    typer.Option("--state", help="Only runs in this state: queued, running, finished, failed, diverged, interrupted."),
]
Figure = Annotated[str | None, typer.Option("--figure", help="Only runs that this figure of the paper needs, as fig5.")]
RunIds = Annotated[
    list[str] | None,
    typer.Argument(metavar="[RUN]...", help="Ids, or their first digits; all runs when none is given."),
]


def is_missing(database: str) -> bool:
    """Whether this is the path of a file that does not exist; of a URL only the database itself can tell."""
    return "://" not in database and not Path(database).expanduser().exists()


def open_store(database: str) -> "Store":
    """The store of a command that reads; runs whose process has died are marked interrupted first, where possible.

    Raises InputError when the file is missing: reading must not make one.
    """
    from ssmail.store import Store

    if is_missing(database):
        command = "ssmail train --method ssail --profile quick --seeds 0-4"
        raise InputError(f"there is no database {database}; `{command}` makes one, or name another with --db.")
    store = Store.open(database)
    if not all(store.is_alive(row) for row in store.runs(state="running")):
        with suppress(SsmailError):
            store.mark_stale()
    return store


def select_runs(
    store: "Store",
    ids: list[str] | None,
    method: str | None,
    environment: str | None,
    profile: str | None,
    state: str | None,
    figure: str | None,
) -> "list[RunRow]":
    """The runs that meet every condition given, newest last. Raises InputError for an unknown id, state or figure."""
    from ssmail.paper.results import FIGURES
    from ssmail.plots.series import needed_by
    from ssmail.store import RunState

    if state is not None and state not in list(RunState):
        raise unknown_name("state", state, list(RunState))
    runs = store.runs(ids=ids or None, method=method, environment=environment, profile=profile, state=state)
    if figure is None:
        return runs
    needed = needed_by(FIGURES[figure].name if figure in FIGURES else figure)  # experiments.yaml knows no aliases
    return [run for run in runs if needed(run)]
