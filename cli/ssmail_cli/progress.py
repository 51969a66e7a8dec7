"""Progress of a sweep on stderr: live lines on a terminal, a few log lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from ssmail.errors import printable
from ssmail.plots.formatting import duration
from ssmail_cli.output import note, progress_console, short
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

    from ssmail.execution.cells import Cell, Event

Sweep = Mapping["Cell", Mapping[str, Any]]  # what tells each cell from the others; see sweep.py
Report = Callable[["Event"], None]

LABELS = dict.fromkeys((metrics.validation for metrics in ENVIRONMENT_METRICS.values()), "val") | {
    "discriminator/loss": "disc",
    "critic/loss": "critic",
    "actor/loss": "actor",
    "cloning/loss": "loss",
}
LONG = 60.0  # seconds; what is left of a run that takes longer stands in its log
LOG_LINES = 10  # epochs that are logged of one run
FEW = 10  # up to this many runs, each has a line from the beginning and a log of its epochs


def label(names: Mapping[str, Any]) -> str:
    """{"method": "ssail", "beta": 0.15, "seed": 2} -> "ssail, beta 0.15, seed 2"."""
    return ", ".join(short(value) if name == "method" else f"{name} {short(value)}" for name, value in names.items())


@contextmanager
def reporter(sweep: Sweep) -> Iterator[Report]:
    """Yield a function that shows each event of the training of these cells."""
    labels = {cell: printable(label(names)) for cell, names in sweep.items()}
    if not sys.stderr.isatty():
        yield _Log(labels)
        return
    note(_legend(sweep))
    with _progress() as progress:
        yield _LinePerRun(progress, labels) if len(labels) <= FEW else _RunningRuns(progress, labels)


def _legend(sweep: Sweep) -> str:
    """Return what the columns of the live lines mean."""
    if not any(cell.spec.epochs for cell in sweep):
        return "columns: run, what it does, time it took"
    errors = dict.fromkeys(environment_metrics(cell.spec.environment).validation for cell in sweep)
    return f"columns: run, epochs done, val ({' or '.join(errors)}) and losses in training, time left"


class _AnyCell(dict["Cell", str]):
    """The label of any cell."""

    def __missing__(self, cell: "Cell") -> str:
        return printable(label(describe(cell)))


def worker_log() -> Report:
    """Return a function that logs each event of cells that are not known beforehand."""
    return _Log(_AnyCell())


def describe(cell: "Cell") -> dict[str, Any]:
    """Return what tells a cell from any other: method, environment, settings and seed."""
    from ssmail.config.changes import changes, with_changes

    spec = cell.spec
    settings = with_changes(spec.profile, changes(spec.model_dump()))
    return {"method": spec.method, "env": spec.environment, "profile": settings, "seed": cell.seed}


class _Log:
    """Plain lines: the start and end of each run, and about LOG_LINES of its epochs if there are at most FEW runs.

    Of a run that takes long the first epoch is logged too, and how much time is left.
    """

    def __init__(self, labels: "Mapping[Cell, str]") -> None:
        self._labels, self._ended = labels, 0
        self._began: dict[Cell, tuple[float, int]] = {}  # seconds and epoch at which the run started here

    def __call__(self, event: "Event") -> None:
        name, few = self._labels[event.cell], len(self._labels) <= FEW
        if event.kind == "loading":
            return
        if event.kind in ("started", "resumed"):
            self._began[event.cell] = time.monotonic(), event.epoch
        if event.kind != "epoch":
            self._ended += event.is_final
            count = f"  [{self._ended}/{len(self._labels)}]" if event.is_final and not few else ""
            note(f"{name}: {_headline(event)}{count}")
            return
        left = self._seconds_left(event)
        is_first = event.epoch == self._began[event.cell][1] + 1 and left > LONG
        is_due = event.epoch % max(1, event.epochs // LOG_LINES) == 0 or event.epoch == event.epochs
        if is_first or (few and is_due):
            remark = f"  about {duration(left)} left" if left > LONG else ""
            note(f"{name}: epoch {event.epoch}/{event.epochs}  {_losses(event)}{remark}")

    def _seconds_left(self, event: "Event") -> float:
        """Estimate the time that the run still takes, from the epochs computed here."""
        seconds, before = self._began[event.cell]
        return (time.monotonic() - seconds) / (event.epoch - before) * (event.epochs - event.epoch)


def _progress() -> "Progress":
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=12),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[status]}", markup=False),
        _time_column(),
    )
    return Progress(*columns, console=progress_console())


def _time_column() -> "ProgressColumn":
    """Return a column of the time left, estimated from the first epoch on, or the time that an ended run took."""
    from rich.progress import ProgressColumn, Task
    from rich.text import Text

    class Time(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            done = task.completed - task.fields.get("before", 0)
            if task.elapsed and (task.stop_time is not None or task.finished):
                return Text(str(timedelta(seconds=int(task.elapsed))))
            if task.elapsed and done > 0:
                return Text(f"{duration(task.elapsed / done * (task.remaining or 0.0))} left")
            return Text("")

    return Time()


class _LinePerRun:
    """A live line for each run: waiting, running or ended."""

    def __init__(self, progress: "Progress", labels: "Mapping[Cell, str]") -> None:
        self._progress = progress
        self._tasks = {
            cell: progress.add_task(name, total=cell.spec.epochs, start=False, status="waiting")
            for cell, name in labels.items()
        }

    def __call__(self, event: "Event") -> None:
        _update(self._progress, self._tasks[event.cell], event)


class _RunningRuns:
    """A live line for all runs together, whose bar counts their epochs, and one for each run in progress.

    Epochs that need not be computed are subtracted from the total, so that the remaining time is estimated from the
    work done here.
    """

    def __init__(self, progress: "Progress", labels: "Mapping[Cell, str]") -> None:
        self._progress, self._labels = progress, labels
        self._tasks: dict[Cell, TaskID] = {}
        self._resumed: set[Cell] = set()
        self._left, self._ended = sum(cell.spec.epochs for cell in labels), 0
        self._all = progress.add_task("all", total=self._left, status=self._status())

    def __call__(self, event: "Event") -> None:
        if event.kind == "epoch":
            self._progress.advance(self._all)
            _update(self._progress, self._tasks[event.cell], event)
        elif event.is_final:
            self._end(event)
        elif event.kind == "elsewhere":
            note(f"{self._labels[event.cell]}: {_headline(event)}")
        else:
            if event.cell not in self._tasks:
                task = self._progress.add_task(self._labels[event.cell], total=event.epochs, start=False, status="")
                self._tasks[event.cell] = task
            _update(self._progress, self._tasks[event.cell], event)
            if event.kind == "resumed" and event.cell not in self._resumed:  # what it computes again, it tells once
                self._resumed.add(event.cell)
                self._subtract(event.epoch)

    def _end(self, event: "Event") -> None:
        """Replace the live line of the run by a line of text above."""
        self._ended += 1
        note(f"{self._labels[event.cell]}: {_headline(event)}")  # rich puts what is written to stderr above its lines
        if event.cell in self._tasks:
            self._progress.remove_task(self._tasks.pop(event.cell))
        self._subtract(event.epochs - (0 if event.kind == "skipped" else event.epoch))

    def _subtract(self, epochs: int) -> None:
        """Subtract epochs that will not be computed from the total."""
        self._left -= epochs
        self._progress.update(self._all, total=self._left, status=self._status())

    def _status(self) -> str:
        return f"{self._ended} of {len(self._labels)} runs ended"


def _update(progress: "Progress", task: "TaskID", event: "Event") -> None:
    if event.kind in ("loading", "elsewhere"):
        progress.update(task, status="loading" if event.kind == "loading" else _headline(event))
    elif event.kind in ("started", "resumed"):
        progress.reset(task, completed=event.epoch, status=_headline(event), before=event.epoch)
    elif event.kind == "epoch":
        progress.update(task, completed=event.epoch, status=_losses(event))
    else:
        progress.update(task, completed=event.epoch, status=_headline(event))
        progress.stop_task(task)


def _headline(event: "Event") -> str:
    """Return what happened to the run, in a few words."""
    run = f" (run {event.run_id[:8]})" if event.run_id else ""
    error = event.metrics.get(environment_metrics(event.cell.spec.environment).error)
    words = {
        "started": f"started{run}",
        "resumed": f"resumed after epoch {event.epoch}{run}" + (f": {event.message}" if event.message else ""),
        "skipped": f"skipped: {event.message}",
        "elsewhere": event.message,
        "finished": f"finished{run}" + ("" if error is None else f": test error {error:.4g}"),
    }
    return printable(words.get(event.kind, f"{event.kind}{run}"))


def _losses(event: "Event") -> str:
    """Return the losses of an epoch and the validation error of its environment."""
    metrics, validation = event.metrics, environment_metrics(event.cell.spec.environment).validation
    shown = [name for name in LABELS if name in metrics and (name == validation or not name.startswith("validation/"))]
    return "  ".join(f"{LABELS[name]} {metrics[name]:.3g}" for name in shown)
