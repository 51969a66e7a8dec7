"""What going straight on costs: the dotted line of figures 4, 6 and 8, and the thin curves of figure 7."""

from collections.abc import Sequence

from ssmail.store import RunRow, Store

REFERENCE = "test_constant_velocity"


def constant_velocity(store: Store, runs: Sequence[RunRow], error: str = "mode_mse") -> float | None:
    """The median over the runs of that test error of constant velocity, in squared scaled units; None without any.

    Every run that finished stores it, and those on one data set agree.
    """
    errors = store.latest_metrics([run.id for run in runs], [f"{REFERENCE}/{error}"])["value"]
    return float(errors.median()) if len(errors) else None
