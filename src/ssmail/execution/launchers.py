"""What starts jobs on a cluster, and what such a job does.

A launcher submits jobs, says which have ended, and cancels them. It knows nothing of cells: a job is a text that
`compute` understands, and so is its result. Which process computes which cell is decided in the database.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError, sentence, shortened
from ssmail.execution.cells import Cell, Event
from ssmail.execution.local import run_cells
from ssmail.store import Store

_PASSED_ON = ("SSMAIL_STALE_SECONDS", "SSMAIL_EXPERIMENTS")  # to the node, where its own environment does not have them
Unended = Literal["failed", "interrupted"]
FAILED: Unended = "failed"
INTERRUPTED: Unended = "interrupted"


@dataclass(frozen=True)
class Ended:
    """A job that has ended: with a result, or without one, which ends its cells as `kind` because of `message`."""

    job: str
    result: str | None
    kind: Unended = FAILED
    message: str = "its job gave no result"


class Launcher(Protocol):
    """Starts jobs on the nodes of a cluster."""

    def submit(self, jobs: Sequence[str]) -> list[str]:
        """Submit a job for each text, which is for `compute`; return their names, in this order.

        Raises InputError if the cluster refuses them.
        """

    def poll(self) -> list[Ended]:
        """Return the jobs that have ended since the last call. Does not wait."""

    def cancel(self) -> None:
        """Let no job begin that has not, and ask the others to stop. Jobs that end of this are polled as usual."""

    def close(self) -> None:
        """Leave the cluster."""


def job_text(cells: Sequence[Cell], store: Store, device: str, per_device: int, processes: int) -> str:
    """Return the job that computes these cells, in so many processes at a time, as `compute` reads it."""
    return json.dumps(
        {
            "cells": [[json.loads(cell.spec.as_json()), cell.seed] for cell in cells],
            "store_url": store.url,
            "artifacts": store.storage.place if store.storage else None,
            "device": device,
            "per_device": per_device,
            "processes": processes,
            "folder": str(Path.cwd()),
            "environment": {name: os.environ[name] for name in _PASSED_ON if name in os.environ},
        }
    )


def compute(text: str) -> str:
    """Compute the cells of a job, and return their final events as lines, in their order.

    Runs on a node, in a process of its own. Relative paths are those of the folder in which the sweep was started, if
    the node has that folder. Cells that cannot be computed because of the user's input have failed.
    """
    job = json.loads(text)
    with suppress(OSError):
        os.chdir(job["folder"])
    os.environ.update(job["environment"])
    cells = [Cell(RunSpec.model_validate(spec), seed) for spec, seed in job["cells"]]
    try:
        given = {name: job[name] for name in ("store_url", "artifacts", "device", "per_device")}
        events = run_cells(cells, jobs=job["processes"], on_event=_log, **given)
    except SsmailError as error:
        bad_input = isinstance(error, InputError)
        events = [_failed(cell, sentence(str(error)), bad_input) for cell in cells]
    return "\n".join(event.as_line() for event in events)


def events_of(result: str, cells: Sequence[Cell]) -> list[Event]:
    """Return the final event of each cell of a job from its result. Raises ValueError if it is none."""
    lines = result.splitlines()
    return [Event.from_line(line, cell.spec) for line, cell in zip(lines, cells, strict=True)]


def was_interrupted(result: str) -> bool:
    """Return whether a cell of the job was interrupted."""
    return any(json.loads(line)["kind"] == "interrupted" for line in result.splitlines())


def _failed(cell: Cell, message: str, bad_input: bool) -> Event:
    return Event("failed", cell, None, 0, cell.spec.epochs, message=message, bad_input=bad_input)


def _log(event: Event) -> None:
    """Write what happens to a cell into the log of the job."""
    if event.kind != "epoch":
        run = f", run {event.run_id[:8]}" if event.run_id else ""
        print(
            f"{event.cell.spec.method}, seed {event.cell.seed}{run}: {event.kind} {event.message}".strip(), flush=True
        )


# -- settings: --launcher-set KEY=VALUE ----------------------------------------------------------------------------


def whole(settings: Mapping[str, Any], key: str, default: int, least: int = 1) -> int:
    """Return the setting as a whole number. Raises InputError for anything else."""
    text = str(settings.get(key, default))
    if not text.isdecimal() or len(text) > 9 or int(text) < least:
        raise wrong_setting(key, text, f"a whole number of at least {least}")
    return int(text)


def wrong_setting(key: str, text: str, expected: str) -> InputError:
    """An InputError for the value of a setting."""
    return InputError(f"--launcher-set {key} takes {expected}, not '{shortened(text, 60)}'")
