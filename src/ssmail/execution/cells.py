"""Cells, the settings and jobs that say how to compute them, and the events that report on them."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, Self

from ssmail.config.spec import RunSpec
from ssmail.execution import Resume
from ssmail.store import HEARTBEAT_SECONDS
from ssmail.store.queue import Claim

Kind = Literal[
    "elsewhere", "loading", "started", "resumed", "skipped", "epoch", "finished", "failed", "diverged", "interrupted"
]
NO_LONGER_STORED = "its run is no longer in the database: it was deleted, or the database replaced, meanwhile"
"""What became of a run that ended well but is not stored."""
AUTO = "auto"
"""The device of a cell for which the process that computes it chooses: a GPU when there is one."""
_FINAL = ("skipped", "finished", "failed", "diverged", "interrupted")


@dataclass(frozen=True)
class Cell:
    """One run to compute: a spec and a seed."""

    spec: RunSpec
    seed: int


@dataclass(frozen=True)
class Event:
    """Something that happened to a cell.

    elsewhere: another process computes the cell, as `message` says. loading: the process of the cell has been started,
    and imports torch. epoch: the number of completed epochs, out of `epochs`. metrics: those of the epoch, or of the
    final evaluation. bad_input: the cell failed before its run started because of the user's input; `message` explains
    why.
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
        """Whether this is the last event of its cell."""
        return self.kind in _FINAL

    def as_line(self) -> str:
        """Return the event, with its seed instead of its cell, as one line of JSON."""
        parts = {name: value for name, value in vars(self).items() if name != "cell"}
        return json.dumps({"seed": self.cell.seed, **parts}, default=dict)

    @classmethod
    def from_line(cls, line: str | bytes, spec: RunSpec) -> Self:
        """Return the event that `as_line` wrote of a cell with this spec."""
        parts = json.loads(line)
        return cls(cell=Cell(spec, parts.pop("seed")), **parts)


@dataclass(frozen=True)
class RunSettings:
    """How to compute a cell. Plain values, so that they can be sent to another process as JSON.

    artifacts: a folder or URL for checkpoints, which may hold a password; None: that of SSMAIL_ARTIFACTS, if it is set.
    """

    device: str = "cpu"
    resume: Resume = Resume.AUTO
    heartbeat_seconds: float = HEARTBEAT_SECONDS
    artifacts: str | None = None


@dataclass(frozen=True)
class Job:
    """Everything that a worker process needs to compute cells of one spec."""

    spec: RunSpec
    seeds: tuple[int, ...]
    store_url: str
    settings: RunSettings
    claims: tuple[Claim, ...] = ()  # of the seeds, in their order

    def as_line(self) -> str:
        """Return the job as one line of JSON."""
        parts: dict[str, Any] = {"seeds": self.seeds, "store_url": self.store_url, "settings": asdict(self.settings)}
        parts["claims"] = [(claim.run_id, claim.owner) for claim in self.claims]
        return json.dumps({**parts, "spec": json.loads(self.spec.as_json())})

    @classmethod
    def from_line(cls, line: str | bytes) -> Self:
        """Return the job that `as_line` wrote."""
        parts = json.loads(line)
        settings = RunSettings(**{**parts["settings"], "resume": Resume(parts["settings"]["resume"])})
        claims = tuple(Claim(*claim) for claim in parts["claims"])
        return cls(RunSpec.model_validate(parts["spec"]), tuple(parts["seeds"]), parts["store_url"], settings, claims)

    @property
    def cells(self) -> list[Cell]:
        """The cells to compute."""
        return [Cell(self.spec, seed) for seed in self.seeds]
