"""Merging the runs of one database into another: each cell once, all or nothing, with the checkpoints.

A cell is a spec, a seed and the data. Of two runs of a cell, a finished or diverged ("settled") one is preferred to an
unfinished one, and of two unfinished ones the one that got further is kept. Of two settled runs the one in the target
is kept; if they disagree, the disagreement is reported as nondeterminism.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy import URL, Connection, delete, select

from ssmail.errors import InputError
from ssmail.store import queries, schema, server
from ssmail.store.artifact_storage import NOT_GIVEN, ArtifactStorage, recorded_fault, storage_of
from ssmail.store.checkpoint_files import CheckpointCopies, checkpoint_root, fault_of
from ssmail.store.connection import as_url, connect, name_of, reading, writing
from ssmail.store.maintenance.checks import Problem, damaged_rows, damaged_run, faults_of
from ssmail.store.maintenance.run_rows import CHILDREN, Difference, amount, copy_run, first_difference
from ssmail.store.maintenance.whole_databases import existing, is_missing, opened, place_of, require_current, revision
from ssmail.store.queries import ArtifactRow, RunRow
from ssmail.store.validation import DamagedRow, raw


class Fate(StrEnum):
    """What happens to a run of the other database."""

    ADDED = "added"  # the target has no run of its cell
    REPLACED = "replaced"  # it replaces runs that got less far or recorded less
    ALREADY_THERE = "already there"
    BEHIND = "behind"  # the target's run got further
    BUSY = "busy"  # it or the target's run is being computed
    DIFFERENT = "different"  # both runs are settled and disagree


@dataclass(frozen=True)
class MergedRun:
    """A run of the other database, its fate, and the ids of the target's runs that it replaces."""

    run: RunRow
    fate: Fate
    replaces: tuple[str, ...] = ()
    difference: Difference | None = None

    @property
    def enters(self) -> bool:
        """Whether the run is copied into the target."""
        return self.fate in (Fate.ADDED, Fate.REPLACED)


@dataclass(frozen=True)
class Merge:
    """What a merge did with each run of the other database."""

    target: Path | str  # the path of a file; the URL on a server, without the password
    other: Path | str
    runs: tuple[MergedRun, ...]
    without_checkpoints: tuple[str, ...]  # ids of copied runs whose recorded files are not all there
    damaged: tuple[Problem, ...]  # what is wrong with the runs that were left out for it, one problem of each

    def count(self, fate: Fate) -> int:
        """Return the number of runs with this fate."""
        return sum(item.fate is fate for item in self.runs)

    @property
    def differences(self) -> tuple[Difference, ...]:
        """The differences between the runs that disagree."""
        return tuple(item.difference for item in self.runs if item.difference is not None)


def merge(where: str | Path, other: str | Path, artifacts: str | None = None) -> Merge:
    """Merge the runs of the database `other`, which is only read, into the one at `where`; create it if necessary.

    Runs with damaged rows are left out. The merge is one transaction: if it fails, or the process dies at any moment,
    the target keeps its contents. artifacts: a folder or URL that has the checkpoints of both databases, or gets those
    beside `other` (see `Store.open`); nothing is deleted there. Raises InputError when a database cannot be used, when
    both are the same one, or when one has another schema.
    """
    source, target, storage = existing(other), as_url(where), storage_of(artifacts)
    if _is_same(source, target):
        raise InputError(f"{name_of(source)} is the database itself; give another one to merge into it")
    require_current(source)
    if not is_missing(target) and revision(target) is not None:
        require_current(target)
    connect(where).dispose()  # creates the file, its folder and its tables, or waits for the process that does so
    copies = CheckpointCopies(checkpoint_root(source), checkpoint_root(target))
    try:
        merged, damaged = _merge(source, target, copies, storage)
        # after the transaction: exchange the checkpoints of runs that the target had before
        copies.place(item.run.id for item in merged if item.enters or item.fate is Fate.ALREADY_THERE)
        copies.commit()
        entered = [item.run.id for item in merged if item.enters]
        copies.remove({run_id for item in merged for run_id in item.replaces}.difference(entered))
    except BaseException:
        copies.undo()
        raise
    finally:
        copies.close()
    with opened(target) as engine, reading(engine) as connection:
        files = {run_id: queries.artifacts(connection, run_id, copies.target) for run_id in entered}
    incomplete = tuple(run_id for run_id, rows in files.items() if not _are_intact(rows, storage))
    return Merge(place_of(target), place_of(source), tuple(merged), incomplete, damaged)


def _is_same(source: URL, target: URL) -> bool:
    """Return whether the two are one database. On servers it may have several URLs; all runs are there already then."""
    if is_missing(target) or target.get_backend_name() != source.get_backend_name():
        return False
    if target.get_backend_name() == "sqlite":
        return Path(str(source.database)).samefile(str(target.database))
    return source == target


def _merge(
    source: URL, target: URL, copies: CheckpointCopies, storage: ArtifactStorage | None
) -> tuple[list[MergedRun], tuple[Problem, ...]]:
    """Copy the checkpoints before locking the target; then decide again, and write in one transaction."""
    with opened(source) as theirs, opened(target) as ours:
        with reading(theirs) as there, reading(ours) as here:
            damaged = _damaged(source, here, there)
            merged = _leave_out(decide_fates(here, there, damaged), there, damaged)
            copies.stage(_wanted_folders(merged, here, copies, storage))
            if storage is not None:
                _put_files([item.run.id for item in merged if item.enters], there, copies.source, storage)
        with reading(theirs) as there, writing(ours) as here:
            server.lock_runs(here)
            merged = decide_fates(here, there, damaged)
            copies.stage(item.run.id for item in merged if item.enters and item.run.state.settled)
            before = {run.id for run in queries.runs(here)}
            replaced = [run_id for item in merged for run_id in item.replaces]
            here.execute(delete(schema.run).where(schema.run.c.id.in_(replaced)))
            for item in merged:
                if item.enters:
                    copy_run(there, here, item.run.id)
            copies.place(item.run.id for item in merged if item.enters and item.run.id not in before)
        copies.commit()
    return merged, tuple(damaged.values())


def _damaged(source: URL, here: Connection, there: Connection) -> dict[str, Problem]:
    """Return a problem of each run of `there` that cannot be copied, by its id or what is shown of it."""
    rows: set[DamagedRow] = set()
    blocking: set[DamagedRow] = set()
    runs = queries.runs(there, damaged=rows)
    queries.runs(here, damaged=blocking)
    found = {problem.subject: problem for problem in (damaged_run(source, row) for row in rows)}
    for run in runs:
        if run.id in {row.run_id for row in blocking}:
            text = f"run {run.name} is damaged in the database that it would be merged into"
            found[run.id] = Problem("rows", run.id, text, f"delete it there (`ssmail runs delete {run.name}`)")
        elif problem := next(damaged_rows(there, run), None):
            found[run.id] = problem
        elif here.dialect.name != "sqlite" and (fault := _length_fault(there, run)):
            found[run.id] = Problem("rows", run.id, f"{fault} (run {run.name})", "keep this run in an SQLite file")
    return found


def _length_fault(there: Connection, run: RunRow) -> str | None:
    """Return what of a run in an SQLite file of an earlier version a server does not store, or None."""
    for table in (schema.run, *CHILDREN):
        key = table.c.id if table is schema.run else table.c.run_id
        texts = [column for column in raw(table) if isinstance(table.c[column.name].type, sa.String)]
        for row in there.execute(select(*texts).where(key == run.id)).mappings():
            if fault := schema.length_fault(table, {**row}):
                return fault
    return None


def _leave_out(merged: Sequence[MergedRun], there: Connection, damaged: dict[str, Problem]) -> list[MergedRun]:
    """Return the runs without those that would enter and contradict themselves, whose problems go to `damaged`."""
    kept = []
    for item in merged:
        problem = next(faults_of(there, item.run), None) if item.enters else None
        if problem is None:
            kept.append(item)
        else:
            damaged[item.run.id] = problem
    return kept


def decide_fates(here: Connection, there: Connection, without: Collection[str] = ()) -> list[MergedRun]:
    """Decide what happens to each run of `there`, but those `without` (ids), given the runs of `here`."""
    ours = queries.runs(here)
    by_id = {run.id: run for run in ours}
    cells: dict[tuple[str, int, str | None], list[RunRow]] = {}
    for run in ours:
        cells.setdefault(run.cell, []).append(run)
    here_now, there_now = queries.clock(here), queries.clock(there)
    merged = []
    for run in (run for run in queries.runs(there) if run.id not in without):
        rivals = [by_id[run.id]] if run.id in by_id else cells.get(run.cell, [])
        settled = [rival for rival in rivals if rival.state.settled]
        if run.is_alive(now=there_now) or any(rival.is_alive(now=here_now) for rival in rivals):
            merged.append(MergedRun(run, Fate.BUSY))
        elif not rivals:
            merged.append(MergedRun(run, Fate.ADDED))
        elif run.state.settled and settled:
            merged.append(_between_settled(here, there, run, settled))
        else:
            merged.append(_with_an_unfinished(here, there, run, rivals))
    return merged


def _between_settled(here: Connection, there: Connection, run: RunRow, rivals: Sequence[RunRow]) -> MergedRun:
    """Keep the fuller copy if the run equals one of its rivals; otherwise report how it differs from the newest."""
    for rival in reversed(rivals):
        if first_difference(here, rival, there, run) is None:
            if amount(there, run.id) > amount(here, rival.id):
                return MergedRun(run, Fate.REPLACED, (rival.id,))
            return MergedRun(run, Fate.ALREADY_THERE)
    return MergedRun(run, Fate.DIFFERENT, difference=first_difference(here, rivals[-1], there, run))


def _with_an_unfinished(here: Connection, there: Connection, run: RunRow, rivals: Sequence[RunRow]) -> MergedRun:
    """Keep the settled run; if there is none, the one that got further."""
    ids = tuple(rival.id for rival in rivals)
    if run.state.settled:
        return MergedRun(run, Fate.REPLACED, ids)
    if any(rival.state.settled for rival in rivals):
        return MergedRun(run, Fate.BEHIND)
    theirs, ours = amount(there, run.id), max(amount(here, rival.id) for rival in rivals)
    if theirs > ours:
        return MergedRun(run, Fate.REPLACED, ids)
    return MergedRun(run, Fate.ALREADY_THERE if theirs == ours else Fate.BEHIND)


def _wanted_folders(
    merged: Sequence[MergedRun], here: Connection, copies: CheckpointCopies, storage: ArtifactStorage | None
) -> list[str]:
    """Return the ids of the runs to copy, and of those already there whose files are intact only in the source."""

    def is_intact(run_id: str, root: Path) -> bool:
        return _are_intact(queries.artifacts(here, run_id, root), storage)

    there = [item.run.id for item in merged if item.fate is Fate.ALREADY_THERE]
    repaired = [run_id for run_id in there if not is_intact(run_id, copies.target) and is_intact(run_id, copies.source)]
    return [item.run.id for item in merged if item.enters] + repaired


def _are_intact(rows: Sequence[ArtifactRow], storage: ArtifactStorage | None) -> bool:
    """Return whether checkpoints are as recorded, as far as can be seen."""
    return all(recorded_fault(row, storage) in (None, NOT_GIVEN) for row in rows)


def _put_files(run_ids: Sequence[str], there: Connection, root: Path, storage: ArtifactStorage) -> None:
    """Put the recorded checkpoints of these runs into the storage; a merge that fails leaves them there."""
    for run_id in run_ids:
        for row in queries.artifacts(there, run_id, root):
            if row.path is not None and fault_of(row) is None:
                storage.put(run_id, row.path.read_bytes())
