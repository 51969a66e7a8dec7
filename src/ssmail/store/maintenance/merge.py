"""Bringing the runs of one database into another: every cell once, all or nothing, with the checkpoints.

A cell is a spec, a seed and the data. Of the two runs of a cell, a settled one (finished or diverged) beats an
unfinished one, and of two unfinished ones the further one is kept. Two settled ones that agree are one; two that do not
are nondeterminism, which is reported, and the one that was there first stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sqlalchemy import Connection, delete

from ssmail.errors import InputError
from ssmail.store import queries, schema
from ssmail.store.checkpoint_files import CheckpointCopies, fault, root_of
from ssmail.store.connection import connect, reading, writing
from ssmail.store.lifecycle import STALE_SECONDS, is_alive
from ssmail.store.maintenance.run_contents import Difference, amount, carry, first_difference
from ssmail.store.maintenance.sqlite_file import existing, file_of, opened, require_current
from ssmail.store.queries import RunRow


class Fate(StrEnum):
    """What becomes of a run of the other database."""

    ADDED = "added"  # its cell was not there
    REPLACED = "replaced"  # it took the place of a run that had got less far, or recorded less
    ALREADY_THERE = "already there"
    BEHIND = "behind"  # the run that is there got further
    BUSY = "busy"  # it, or the run that is there, is being computed
    DIFFERENT = "different"  # both are settled and do not agree


@dataclass(frozen=True)
class Verdict:
    """What becomes of one run, and which runs of the target go for it."""

    run: RunRow
    fate: Fate
    replaces: tuple[str, ...] = ()
    difference: Difference | None = None

    @property
    def enters(self) -> bool:
        """Whether the run comes into the target."""
        return self.fate in (Fate.ADDED, Fate.REPLACED)


@dataclass(frozen=True)
class Merge:
    """What a merge did: the runs of the other database, each with its fate, and the checkpoints that did not follow."""

    target: Path
    other: Path
    verdicts: tuple[Verdict, ...]
    without_checkpoints: tuple[str, ...]  # ids of runs that came in without a file that they recorded

    def count(self, fate: Fate) -> int:
        """How many runs had this fate."""
        return sum(verdict.fate is fate for verdict in self.verdicts)

    @property
    def differences(self) -> tuple[Difference, ...]:
        """The cells whose two runs do not agree."""
        return tuple(item.difference for item in self.verdicts if item.difference is not None)


def merge(where: str | Path, other: str | Path, *, stale_seconds: float = STALE_SECONDS) -> Merge:
    """Bring the runs of the database `other`, which is only read, into that at `where`, which is made if need be.

    One transaction: after a failure, or a death at any moment, the target holds what it held. Raises InputError for a
    file that cannot be used, for the same file twice, and for another schema, naming the remedy.
    """
    source, target = existing(other), file_of(where)
    if target.exists() and source.samefile(target):
        raise InputError(f"{source} is the database itself; give another one to merge into it")
    for path in (source, target):
        if path.exists():
            require_current(path)
    connect(target).dispose()  # makes the file, in a folder that may be missing
    copies = CheckpointCopies(root_of(source), root_of(target))
    try:
        verdicts = _merge(source, target, copies, stale_seconds)
        copies.place(
            item.run.id for item in verdicts if item.enters or item.fate is Fate.ALREADY_THERE
        )  # over old ones
        copies.settle()
        copies.remove(_gone(verdicts))
    except BaseException:
        copies.undo()
        raise
    finally:
        copies.close()
    return Merge(target, source, tuple(verdicts), _without_checkpoints(target, verdicts))


def _merge(source: Path, target: Path, copies: CheckpointCopies, stale_seconds: float) -> list[Verdict]:
    """Copy files aside while nobody waits; then judge again and write, in one transaction."""
    with opened(source) as theirs, opened(target) as ours:
        with reading(theirs) as there, reading(ours) as here:
            copies.stage(_wanted_folders(judge(here, there, stale_seconds), here, copies))
        with reading(theirs) as there, writing(ours) as here:
            verdicts = judge(here, there, stale_seconds)
            copies.stage(item.run.id for item in verdicts if item.enters and item.run.state.settled)
            before = {run.id for run in queries.runs(here)}
            gone = [run_id for verdict in verdicts for run_id in verdict.replaces]
            here.execute(delete(schema.run).where(schema.run.c.id.in_(gone)))
            for verdict in verdicts:
                if verdict.enters:
                    carry(there, here, verdict.run.id)
            copies.place(item.run.id for item in verdicts if item.enters and item.run.id not in before)
        copies.settle()
    return verdicts


def judge(here: Connection, there: Connection, stale_seconds: float) -> list[Verdict]:
    """What is to become of each run of `there`, in view of those of `here`."""
    ours = queries.runs(here)
    by_id = {run.id: run for run in ours}
    cells: dict[tuple[str, int, str | None], list[RunRow]] = {}
    for run in ours:
        cells.setdefault(_cell(run), []).append(run)
    verdicts = []
    for run in queries.runs(there):
        rivals = [by_id[run.id]] if run.id in by_id else cells.get(_cell(run), [])
        if any(is_alive(item, stale_seconds) for item in (run, *rivals)):
            verdicts.append(Verdict(run, Fate.BUSY))
        elif not rivals:
            verdicts.append(Verdict(run, Fate.ADDED))
        elif run.state.settled and any(rival.state.settled for rival in rivals):
            verdicts.append(_between_settled(here, there, run, [item for item in rivals if item.state.settled]))
        else:
            verdicts.append(_with_an_unfinished(here, there, run, rivals))
    return verdicts


def _cell(run: RunRow) -> tuple[str, int, str | None]:
    return run.spec_hash, run.seed, run.dataset_hash


def _between_settled(here: Connection, there: Connection, run: RunRow, rivals: Sequence[RunRow]) -> Verdict:
    """The same as one of them (the fuller copy is kept), or different from the newest."""
    for rival in reversed(rivals):
        difference = first_difference(here, rival, there, run)
        if difference is None:
            if amount(there, run.id) > amount(here, rival.id):
                return Verdict(run, Fate.REPLACED, (rival.id,))
            return Verdict(run, Fate.ALREADY_THERE)
    return Verdict(run, Fate.DIFFERENT, difference=first_difference(here, rivals[-1], there, run))


def _with_an_unfinished(here: Connection, there: Connection, run: RunRow, rivals: Sequence[RunRow]) -> Verdict:
    """The run or all its rivals are unfinished: the settled one stays, else the one that got further."""
    ids = tuple(rival.id for rival in rivals)
    if run.state.settled:
        return Verdict(run, Fate.REPLACED, ids)
    if any(rival.state.settled for rival in rivals):
        return Verdict(run, Fate.BEHIND)
    got, most = amount(there, run.id), max(amount(here, rival.id) for rival in rivals)
    if got > most:
        return Verdict(run, Fate.REPLACED, ids)
    return Verdict(run, Fate.ALREADY_THERE if got == most else Fate.BEHIND)


def _wanted_folders(verdicts: Sequence[Verdict], here: Connection, copies: CheckpointCopies) -> list[str]:
    """Of the runs that come in, and of those that are there but whose files are sound in the source alone."""

    def is_sound(run_id: str, root: Path) -> bool:
        return not any(fault(row) for row in queries.artifacts(here, run_id, root))

    there = [item.run.id for item in verdicts if item.fate is Fate.ALREADY_THERE]
    mended = [run_id for run_id in there if not is_sound(run_id, copies.target) and is_sound(run_id, copies.source)]
    return [item.run.id for item in verdicts if item.enters] + mended


def _gone(verdicts: Sequence[Verdict]) -> set[str]:
    """Ids of the replaced runs that are no longer in the target."""
    entered = {verdict.run.id for verdict in verdicts if verdict.enters}
    return {run_id for verdict in verdicts for run_id in verdict.replaces} - entered


def _without_checkpoints(target: Path, verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    with opened(target) as engine, reading(engine) as connection:
        entered = [verdict.run.id for verdict in verdicts if verdict.enters]
        files = {run_id: queries.artifacts(connection, run_id, root_of(target)) for run_id in entered}
    return tuple(run_id for run_id, rows in files.items() if any(fault(row) for row in rows))
