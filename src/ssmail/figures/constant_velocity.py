"""What driving straight on costs on Y-Junction: the dotted line of figures 4 and 6."""

from collections.abc import Sequence

from ssmail.store import RunRow, Store

METRIC = "test_constant_velocity/mode_mse"


def constant_velocity(store: Store, runs: Sequence[RunRow]) -> float | None:
    """The median over the runs of the test error of constant velocity, in squared scaled units; None without any.

    Every run that finished stores it, and those on one data set agree.
    """
    errors = store.latest_metrics([run.id for run in runs], [METRIC])["value"]
    return float(errors.median()) if len(errors) else None
