"""What a run recorded, as plain rows: compared with that of another run, and carried into another database."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, func, insert, select

from ssmail.store import schema
from ssmail.store.queries import RunRow

NOT_COMPARED = ("seconds",)
"""Metrics that tell of the machine and not of the run."""
CHILDREN = (schema.metric, schema.metric_latest, schema.array, schema.artifact)
_ROWS = 500  # at a time

Value = tuple[str, float | None]  # kind, value
Values = dict[tuple[int, str], Value]  # by step and name


@dataclass(frozen=True)
class Difference:
    """Two runs of one cell that do not agree: the first metric that differs, by step and then by name.

    A value is None where that run has none, and text where it is not finite. `metric` may be `state`, at no step.
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


def amount(connection: Connection, run_id: str) -> tuple[int, ...]:
    """How much the run recorded, to be compared: its last step, and its rows in each table."""
    step = select(func.coalesce(func.max(schema.metric.c.step), 0)).where(schema.metric.c.run_id == run_id)
    counts = (select(func.count()).select_from(table).where(table.c.run_id == run_id) for table in CHILDREN)
    return tuple(int(connection.execute(query).scalar_one()) for query in (step, *counts))


def first_difference(here: Connection, kept: RunRow, there: Connection, other: RunRow) -> Difference | None:
    """Where two settled runs of one cell part first; None when they agree.

    They agree when they ended in the same state, with the same last value of every metric, and wherever both have a
    value of the same metric and step it is the same; how long epochs took is not compared.
    """
    ours, theirs = (_values(*pair, schema.metric) for pair in ((here, kept.id), (there, other.id)))
    our_last, their_last = (_values(*pair, schema.metric_latest) for pair in ((here, kept.id), (there, other.id)))
    common = ours.keys() & theirs.keys()  # a compact copy has fewer
    last = {key for key, _ in our_last.items() ^ their_last.items()}
    ours, theirs = ours | our_last, theirs | their_last
    parted = {key for key in common | last if ours.get(key) != theirs.get(key)}
    names = (kept.method, kept.environment, kept.seed, kept.spec_hash, kept.id, other.id)
    if parted:
        step, name = min(parted)
        return Difference(*names, name, step, _shown(ours.get((step, name))), _shown(theirs.get((step, name))))
    if kept.state is not other.state:
        return Difference(*names, "state", None, kept.state.value, other.state.value)
    return None


def carry(there: Connection, here: Connection, run_id: str) -> None:
    """Insert the run's rows of every table of `there` into `here`, where there is no such run."""
    for rows, table in _rows(there, run_id):
        here.execute(insert(table), rows)


def _rows(connection: Connection, run_id: str) -> Iterator[tuple[list[dict[str, Any]], Table]]:
    for table in (schema.run, *CHILDREN):
        key = table.c.id if table is schema.run else table.c.run_id
        for part in connection.execute(select(table).where(key == run_id)).mappings().partitions(_ROWS):
            yield [dict(row) for row in part], table


def _values(connection: Connection, run_id: str, table: Table) -> Values:
    query = select(table.c.step, table.c.name, table.c.kind, table.c.value).where(table.c.run_id == run_id)
    rows = connection.execute(query.where(table.c.name.not_in(NOT_COMPARED)))
    return {(step, name): (kind, value) for step, name, kind, value in rows}


def _shown(value: Value | None) -> float | str | None:
    if value is None:
        return None
    kind, number = value
    return number if kind == "finite" else kind
