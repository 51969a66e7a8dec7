"""How training shows itself on stderr: a live line for each seed on a terminal, a few log lines elsewhere."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ssmail_cli.display import note

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ssmail.execution.local import Event

Report = Callable[["Event"], None]

LABELS = {
    "validation/mode_mse": "val",
    "discriminator/loss": "disc",
    "critic/loss": "critic",
    "actor/loss": "actor",
}
LOG_LINES = 10  # of the epochs of one run


@contextmanager
def reporter(seeds: Sequence[int], epochs: int) -> Iterator[Report]:
    """A function that shows each Event of the training of these seeds, `epochs` epochs each."""
    if sys.stderr.isatty():
        with _live(seeds, epochs) as report:
            yield report
    else:
        yield _Log()


class _Log:
    """Plain lines: when a run starts and ends, and about LOG_LINES of its epochs."""

    def __call__(self, event: "Event") -> None:
        seed = f"seed {event.cell.seed}"
        if event.kind != "epoch":
            note(f"{seed}: {_headline(event)}")
        elif event.epoch % max(1, event.epochs // LOG_LINES) == 0 or event.epoch == event.epochs:
            note(f"{seed}: epoch {event.epoch}/{event.epochs}  {_losses(event.metrics)}")


@contextmanager
def _live(seeds: Sequence[int], epochs: int) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=12),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[status]}", markup=False),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=120) as progress:
        tasks = {seed: progress.add_task(f"seed {seed}", total=epochs, start=False, status="waiting") for seed in seeds}

        def report(event: "Event") -> None:
            _update(progress, tasks[event.cell.seed], event)

        yield report


def _update(progress: Any, task: "TaskID", event: "Event") -> None:
    if event.kind in ("started", "resumed"):
        progress.reset(task, completed=event.epoch, status=_headline(event))
    elif event.kind == "epoch":
        progress.update(task, completed=event.epoch, status=_losses(event.metrics))
    else:
        progress.update(task, completed=event.epoch, status=_headline(event))
        progress.stop_task(task)


def _headline(event: "Event") -> str:
    """What happened to the run, in a few words."""
    run = f" (run {event.run_id[:8]})" if event.run_id else ""
    words = {
        "started": f"started{run}",
        "resumed": f"resumed after epoch {event.epoch}{run}",
        "skipped": f"skipped: {event.message}",
        "finished": f"finished{run}: test error {event.metrics.get('test/mode_mse', math.nan):.4g}",
    }
    return words.get(event.kind, f"{event.kind}{run}")


def _losses(metrics: Mapping[str, float]) -> str:
    return "  ".join(f"{label} {metrics[name]:.3g}" for name, label in LABELS.items() if name in metrics)
