"""Stored runs as rows to print, and the metrics shown of each environment."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store


@dataclass(frozen=True)
class EnvironmentMetrics:
    """The metrics that the command line shows of one environment, by their stored names.

    error: the test error of a finished run. validation: the error of an epoch. curve: drawn by `ssmail plot training`.
    compared: shown by `ssmail runs compare`, each with its heading in the table of a training command (None: none).
    beside: rows that its tables have beside the specs, with the prefix under which every run stores their metrics.
    spare: what its tables leave out first in a narrow terminal.
    """

    error: str
    validation: str
    curve: str
    compared: Mapping[str, str | None]
    beside: Mapping[str, str] = field(default_factory=dict)
    spare: Sequence[str] = ()


ENVIRONMENT_METRICS = {
    "yjunction": EnvironmentMetrics(
        error="test/mode_mse",
        validation="validation/mode_mse",
        curve="train/mode_mse",
        compared={
            "test/mode_mse": "mode_mse",
            "test/on_path": "on_path",
            "test/path_rms": "path_rms",
            "test/lane_balance": "balance",
            "test/min_fde_20": None,
            "test/diverged": None,
            "test_constant_velocity/mode_mse": "const.\nvelocity",
        },
    ),
    "letters": EnvironmentMetrics(
        error="test/stroke_distance",
        validation="validation/stroke_distance",
        curve="validation/stroke_distance",
        compared={
            "test/stroke_distance": "stroke\ndistance",
            "test_mean/stroke_distance": "by the\nmean",
            "test_last/stroke_distance": "last\nepoch",
            "test/ade": "ade",
            "test_constant_velocity/stroke_distance": "const.\nvelocity",
            "test/diverged": "diverged",
        },
    ),
    "mocap": EnvironmentMetrics(
        error="test/mse_40",
        validation="validation/mse",
        curve="validation/mse",
        compared={
            "test/mse_10": "mse_10",
            "test/mse_20": "mse_20",
            "test/mse_40": "mse_40",
            "test_noisy/mse_40": "noisy\nmse_40",
            "test_constant_velocity/mse_40": "const.\nvelocity",
            "test/diverged": "diverged",
        },
    ),
    "trajectories": EnvironmentMetrics(
        error="test/fde",
        validation="validation/energy",
        curve="validation/energy",
        compared={
            "test/ade": "ade",
            "test/fde": "fde",
            "test/energy": None,
            "test/min_fde_5": None,
            "test/min_fde_20": "min_fde\n_20",
            "test/min_fde_20_agent": None,
            "test/miss_rate_20": None,
            "test/collisions": None,
            "test/coverage": "coverage",
            "test/mse_last": "mse at\nthe end",
            "test_constant_velocity/fde": "const.\nvelocity",
            "test_constant_velocity/mse_last": None,
            "test_constant_velocity/energy": None,
            "test_copy_last/fde": None,
            "test_copy_last/mse_last": None,
            "test/diverged": None,
        },
        beside={
            "constant velocity": "test_constant_velocity",
            "copy last": "test_copy_last",
            "true futures": "test_expert",
        },
        spare=(
            "test/min_fde_5",
            "test/mse_last",
            "test/diverged",
            "test/miss_rate_20",
            "test/coverage",
            "test/min_fde_20_agent",
            "test/ade",
        ),
    ),
}


def environment_metrics(environment: str) -> EnvironmentMetrics:
    """Return the metrics of the environment; for an unknown one those of the Y-Junction."""
    return ENVIRONMENT_METRICS.get(environment, ENVIRONMENT_METRICS["yjunction"])


def key_metrics(environments: Iterable[str]) -> dict[str, str | None]:
    """Return the compared metrics of all of these environments, each once, with their headings."""
    return {
        name: heading
        for environment in environments
        for name, heading in environment_metrics(environment).compared.items()
    }


def run_row(run: "RunRow") -> dict[str, Any]:
    """Return the columns of a stored run by name, without its spec and its owner; `settings` and `changes` tell how the
    spec differs from the profile, `deterministic` whether the device gives the same numbers each time.
    """
    row: dict[str, Any] = {}
    for item in fields(run):
        if item.name not in ("spec_json", "owner"):
            row[item.name] = getattr(run, item.name)
        if item.name == "profile":
            row |= {"settings": run.settings, "changes": run.changes}
        if item.name == "device":
            row["deterministic"] = run.deterministic
    return row


def rows_with_metrics(store: "Store", runs: "Sequence[RunRow]", names: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row for each run: its short id as `run`, its columns, and the last value of each metric or None."""
    from ssmail.store.comparison import latest_values

    latest = latest_values(store, runs, names)
    return [{"run": run.name, **run_row(run)} | {name: latest.get((run.id, name)) for name in names} for run in runs]
