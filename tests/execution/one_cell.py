"""Computing a single cell in this process."""

from collections.abc import Callable

from ssmail.execution.cells import Cell, Event, RunSettings
from ssmail.execution.run_together import MakeLoop, run_together
from ssmail.store import Store
from ssmail.training.loop import TrainingLoop


def run_cell(
    cell: Cell,
    store: Store,
    settings: RunSettings,
    on_event: Callable[[Event], None],
    should_stop: Callable[[], bool],
    make_loop: MakeLoop = TrainingLoop,
) -> Event:
    """The cell's final event; all earlier ones go to `on_event`."""
    events: list[Event] = []

    def keep(event: Event) -> None:
        (events.append if event.is_final else on_event)(event)

    run_together([cell], store, settings, keep, should_stop, make_loop)
    (final,) = events
    return final
