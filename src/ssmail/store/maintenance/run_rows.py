"""The rows that a run recorded: copied to another database, or compared with those of another run."""

from dataclasses import dataclass
from itertools import islice

from sqlalchemy import ColumnElement, Connection, Table, insert, select

from ssmail.store import schema
from ssmail.store.queries import RunRow, count_rows, last_step, refuse, rows_of, sound_rows
from ssmail.store.validation import DamagedRow, raw

NOT_COMPARED = ("seconds",)
"""Metrics that depend on the machine and not on the run."""
CHILDREN = (schema.metric, schema.metric_latest, schema.array, schema.artifact)
_BATCH = 500  # rows per INSERT

Value = tuple[str, float | None]  # kind, value
Values = dict[tuple[int, str], Value]  # by step and name


@dataclass(frozen=True)
class Difference:
    """Two runs of one cell that disagree: the first metric that differs, ordered by step and then by name.

    A value is None if that run has none, and a string if it is not finite. `metric` may be "state", with step None.
    """

    method: str
    environment: str
    seed: int
    spec_hash: str
    kept: str  # run id
    left_out: str  # run id
    metric: str
    step: int | None
    kept_value: float | str | None
    left_out_value: float | str | None


def copy_rows(
    source: Connection, target: Connection, table: Table, *conditions: ColumnElement[bool], damaged: set[DamagedRow]
) -> None:
    """Insert the rows of `table` that meet the conditions into the same table of `target`.

    Damaged rows are added to `damaged` instead.
    """
    rows = sound_rows(source, table, select(*raw(table)).where(*conditions), damaged)
    while batch := list(islice(rows, _BATCH)):
        target.execute(insert(table), batch)


def copy_run(source: Connection, target: Connection, run_id: str) -> None:
    """Insert the run with everything it recorded into `target`, which must not contain the run.

    Raises InputError for a damaged row.
    """
    damaged: set[DamagedRow] = set()
    copy_rows(source, target, schema.run, schema.run.c.id == run_id, damaged=damaged)
    for table in CHILDREN:
        copy_rows(source, target, table, table.c.run_id == run_id, damaged=damaged)
    refuse(damaged)


def amount(connection: Connection, run_id: str) -> tuple[int, ...]:
    """Return how much the run recorded, as a tuple to compare: its last step, then its rows in each table."""
    counts = (count_rows(connection, table, table.c.run_id == run_id) for table in CHILDREN)
    return (last_step(connection, run_id), *counts)


def first_difference(here: Connection, kept: RunRow, there: Connection, other: RunRow) -> Difference | None:
    """Return the first difference between two finished or diverged runs of one cell; None when they agree.

    Runs agree if they ended in the same state with the same last value of every metric, and if all values that both
    have for the same metric and step are equal. The duration of epochs is not compared.
    """
    ours, theirs = (_values(*pair, schema.metric) for pair in ((here, kept.id), (there, other.id)))
    our_last, their_last = (_values(*pair, schema.metric_latest) for pair in ((here, kept.id), (there, other.id)))
    common = ours.keys() & theirs.keys()  # a compact copy has fewer
    last = {key for key, _ in our_last.items() ^ their_last.items()}
    ours, theirs = ours | our_last, theirs | their_last
    different = {key for key in common | last if ours.get(key) != theirs.get(key)}
    identity = (kept.method, kept.environment, kept.seed, kept.spec_hash, kept.id, other.id)
    if different:
        step, name = min(different)
        return Difference(*identity, name, step, _plain(ours.get((step, name))), _plain(theirs.get((step, name))))
    if kept.state is not other.state:
        return Difference(*identity, "state", None, kept.state.value, other.state.value)
    return None


def _values(connection: Connection, run_id: str, table: Table) -> Values:
    rows = rows_of(connection, table, run_id)
    return {(row["step"], row["name"]): (row["kind"], row["value"]) for row in rows if row["name"] not in NOT_COMPARED}


def _plain(value: Value | None) -> float | str | None:
    if value is None:
        return None
    kind, number = value
    return number if kind == "finite" else kind
