"""Stored runs as rows to print, and which of their metrics people want to see."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store


@dataclass(frozen=True)
class Shown:
    """What is shown of the runs on one environment, by the names of stored metrics.

    error: the one number of a finished run. validation: that of an epoch. curve: what `ssmail plot training` draws.
    metrics: what is compared, each with its heading in the table of a training command (None: it is not in there).
    """

    error: str
    validation: str
    curve: str
    metrics: Mapping[str, str | None]


SHOWN = {
    "yjunction": Shown(
        error="test/mode_mse",
        validation="validation/mode_mse",
        curve="train/mode_mse",
        metrics={
            "test/mode_mse": "mode_mse",
            "test/on_lane": "on_lane",
            "test/lane_balance": "balance",
            "test/min_fde_20": "min_fde_20",
            "test/diverged": None,
            "test_constant_velocity/mode_mse": "const.\nvelocity",
        },
    ),
    "letters": Shown(
        error="test/stroke_distance",
        validation="validation/stroke_distance",
        curve="validation/stroke_distance",
        metrics={
            "test/stroke_distance": "stroke\ndistance",
            "test_mean/stroke_distance": "by the\nmean",
            "test_last/stroke_distance": "last\nepoch",
            "test/ade": "ade",
            "test_constant_velocity/stroke_distance": "const.\nvelocity",
            "test/diverged": "diverged",
        },
    ),
    "mocap": Shown(
        error="test/mse_40",
        validation="validation/mse",
        curve="validation/mse",
        metrics={
            "test/mse_10": "mse_10",
            "test/mse_20": "mse_20",
            "test/mse_40": "mse_40",
            "test_noisy/mse_40": "noisy\nmse_40",
            "test_constant_velocity/mse_40": "const.\nvelocity",
            "test/diverged": "diverged",
        },
    ),
}


def shown_on(environment: str) -> Shown:
    """The row of SHOWN; that of the Y-Junction for an environment that this ssmail does not know."""
    return SHOWN.get(environment, SHOWN["yjunction"])


def key_metrics(environments: Iterable[str]) -> dict[str, str | None]:
    """The metrics of all of these environments, each once, with their headings."""
    return {name: heading for environment in environments for name, heading in shown_on(environment).metrics.items()}


def run_row(run: "RunRow") -> dict[str, Any]:
    """Return the columns of a stored run by name, except the long spec and the owner, a random number."""
    return {item.name: getattr(run, item.name) for item in fields(run) if item.name not in ("spec_json", "owner")}


def rows_with_metrics(store: "Store", runs: "Sequence[RunRow]", names: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each run: its short id as `run`, its columns, and the last value of each named metric or None."""
    from ssmail.store.comparison import latest_values

    latest = latest_values(store, runs, names)
    return [{"run": run.name, **run_row(run)} | {name: latest.get((run.id, name)) for name in names} for run in runs]
