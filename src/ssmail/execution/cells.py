"""What is computed (a cell), what is told of it (events), and what is to be done with it (the plan)."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, Self

from ssmail.config.spec import RunSpec
from ssmail.config.user_functions import load_label
from ssmail.data.expert_sets import load
from ssmail.errors import InputError
from ssmail.store import HEARTBEAT_SECONDS, STALE_SECONDS, RunRow, RunState, Store, is_alive
from ssmail.store.lifecycle import refusal

Kind = Literal["started", "resumed", "skipped", "epoch", "finished", "failed", "diverged", "interrupted"]
LAST, BEST = "last.pt", "best.pt"  # the checkpoint files in checkpoint_root/<run id>/
_FINAL = ("skipped", "finished", "failed", "diverged", "interrupted")


@dataclass(frozen=True)
class Cell:
    """One run to compute: a spec and a seed."""

    spec: RunSpec
    seed: int


class Resume(StrEnum):
    """What to do where the store already holds a run of the cell.

    AUTO: skip what is finished or diverged, resume the rest. REQUIRE: the same, but a cell without anything to resume
    is an error. NEVER: begin a new run, and keep the old one.
    """

    AUTO = "auto"
    NEVER = "never"
    REQUIRE = "require"


@dataclass(frozen=True)
class Event:
    """Something that happened to a cell.

    epoch: epochs completed, of `epochs`. metrics: those of the epoch, or of the final evaluation. bad_input: the cell
    failed before its run began because of what the user gave; `message` is the sentence.
    """

    kind: Kind
    cell: Cell
    run_id: str | None
    epoch: int
    epochs: int
    metrics: Mapping[str, float] = field(default_factory=dict)
    message: str = ""
    bad_input: bool = False

    @property
    def is_final(self) -> bool:
        """Whether nothing follows for this cell."""
        return self.kind in _FINAL

    def as_line(self) -> str:
        """One line of JSON, without the cell."""
        return json.dumps({name: value for name, value in vars(self).items() if name != "cell"}, default=dict)

    @classmethod
    def from_line(cls, line: str | bytes, cell: Cell) -> Self:
        """The inverse of `as_line`."""
        return cls(cell=cell, **json.loads(line))


@dataclass(frozen=True)
class Settings:
    """How cells are computed; plain values, so that they reach another process as JSON.

    loop_factory: "module:name" of what is called with (spec, seed, device) and offers what TrainingLoop does.
    """

    device: str = "cpu"
    resume: Resume = Resume.AUTO
    heartbeat_seconds: float = HEARTBEAT_SECONDS
    stale_seconds: float = STALE_SECONDS
    loop_factory: str = "ssmail.training.loop:TrainingLoop"


@dataclass(frozen=True)
class Job:
    """One cell with all that a process needs to compute it."""

    cell: Cell
    store_url: str
    settings: Settings

    def as_line(self) -> str:
        """One line of JSON."""
        parts: dict[str, Any] = {"seed": self.cell.seed, "store_url": self.store_url, "settings": asdict(self.settings)}
        return json.dumps({**parts, "spec": json.loads(self.cell.spec.as_json())})

    @classmethod
    def from_line(cls, line: str | bytes) -> Self:
        """The inverse of `as_line`."""
        parts = json.loads(line)
        settings = Settings(**{**parts["settings"], "resume": Resume(parts["settings"]["resume"])})
        return cls(Cell(RunSpec.model_validate(parts["spec"]), parts["seed"]), parts["store_url"], settings)


@dataclass(frozen=True)
class Plan:
    """What to do with a cell: nothing (`skipped`), resume `row`, or (both None) begin a new run."""

    skipped: Event | None = None
    row: RunRow | None = None


def check_labels(cells: Iterable[Cell]) -> None:
    """Raise InputError when the label function of any of the cells is broken, before one of them is computed."""
    for supervision in dict.fromkeys(cell.spec.self_supervision for cell in cells):
        if supervision is not None and supervision.label != "identity":
            from ssmail.losses.labels import checked_label  # not at the top: a plan must not wait for torch

            checked_label(supervision, load_label(supervision.label))


def _check_data(cell: Cell, row: RunRow) -> None:
    """Raise InputError when the spec names a data file that is no longer the one of the finished run `row`."""
    path = cell.spec.data.path
    if path is not None and load(Path(path), cell.spec.environment).hash != row.dataset_hash:
        raise InputError(f"{path} has changed since run {row.name} was trained on it; train afresh with --resume never")


def plan_cell(store: Store, cell: Cell, settings: Settings) -> Plan:
    """Decide by what the store holds now.

    Raises InputError when another process is computing the cell, when REQUIRE finds nothing to resume, or when the data
    file of a finished cell has changed.
    """
    row = store.find_cell(cell.spec.hash(), cell.seed)
    if row is not None and is_alive(row, settings.stale_seconds):
        raise InputError(refusal(row, settings.stale_seconds))
    if settings.resume is Resume.NEVER:
        return Plan()
    if row is not None and row.state.settled:
        _check_data(cell, row)
        epochs = cell.spec.epochs
        epoch = epochs if row.state is RunState.FINISHED else 0
        message = f"{row.state} already, as run {row.name}"
        return Plan(skipped=Event("skipped", cell, row.id, epoch, epochs, message=message))
    if settings.resume is Resume.REQUIRE and (row is None or not (store.checkpoint_root / row.id / LAST).exists()):
        raise InputError(f"seed {cell.seed} of this spec has no run to resume in {store.where}; use --resume auto")
    return Plan(row=row)
