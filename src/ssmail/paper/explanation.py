"""Explain what a saved figure was drawn from, and compare it with a database."""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import pandas as pd

from ssmail.config.foreign_files import open_regular, read_whole
from ssmail.errors import InputError, stored_values
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.csv_comparison import RELATIVE, first_difference
from ssmail.paper.results import FIGURES
from ssmail.plots import (
    ablation,
    control,
    forecast_curves,
    forecast_trajectories,
    provenance,
    training_curves,
    varied_runs,
)
from ssmail.plots.data_sets import data_sets
from ssmail.plots.provenance import LARGEST, Provenance, RunSource
from ssmail.plots.saving import csv_text, digest
from ssmail.store import RunRow, Store

FILM = ".gif"
ENDINGS = (".png", ".pdf", ".svg", FILM)


@dataclass(frozen=True)
class Explanation:
    """The origin of a figure.

    csv: the path where its CSV should be. csv_state: "as written", "altered", "missing", or None if unknown.
    """

    path: Path
    provenance: Provenance
    csv: Path
    csv_state: str | None


@dataclass(frozen=True)
class Agreement:
    """How a database compares with a figure.

    runs: by run id, "same", "missing", or what has changed. values: "same" (see csv_comparison), "different", or None
    where they cannot be compared. reason: the first difference, why they cannot be compared, or how nearly they are the
    same where they are not so to the last digit.
    """

    where: str
    runs: dict[str, str]
    values: str | None
    reason: str | None

    @property
    def agrees(self) -> bool | None:
        """Whether all runs are unchanged and yield the same values; None where the values cannot be compared."""
        if any(state != "same" for state in self.runs.values()) or self.values == "different":
            return False
        return True if self.values == "same" else None


def explain(path: Path) -> Explanation:
    """Return the origin of a figure, or of the figure that a CSV was written with.

    Raises InputError for a file that is not a figure saved by ssmail, and for a CSV without its figure beside it.
    """
    figure = path
    if path.suffix.lower() == ".csv":
        beside = [path.with_suffix(ending) for ending in ENDINGS if path.with_suffix(ending).exists()]
        if not path.is_file():
            raise InputError(f"{path} cannot be read: there is no such file.")
        if not beside:
            raise InputError(f"{path} has no figure beside it that tells its runs; give the one that it belongs to.")
        figure = beside[0]
    source = provenance.read(figure)
    csv = path if figure is not path else path.with_suffix(".csv")
    return Explanation(figure, source, csv, _csv_state(csv, source))


def compare(explanation: Explanation, store: Store) -> Agreement:
    """Check that the store holds the same runs, and that the figure collected from them again has the same values."""
    source = explanation.provenance
    stored = {run.id: run for run in store.runs()}
    runs = {run_id: _run_state(run_id, source.runs, stored) for run_id in source.run_ids}
    missing = sum(state == "missing" for state in runs.values())
    if not runs:
        return Agreement(store.where, runs, None, "it is drawn from an expert set, not from runs")
    if missing:
        return Agreement(store.where, runs, None, f"{missing} of its {len(runs)} runs are missing")
    if explanation.path.suffix.lower() == FILM:
        return Agreement(store.where, runs, None, "a film keeps no hash of what it shows")
    if source.csv_sha256 is None:
        return Agreement(store.where, runs, None, "an older ssmail drew it, which kept no hash of what it shows")
    try:
        table = _collect_again(source, store)
    except InputError as error:
        return Agreement(store.where, runs, None, str(error).rstrip("."))
    if digest(csv_text(table)) == source.csv_sha256:
        return Agreement(store.where, runs, "same", None)
    if explanation.csv_state != "as written":
        return Agreement(store.where, runs, None, "its hash differs, and the CSV that was written with it is not there")
    difference = first_difference(explanation.csv.name, explanation.csv.read_text("utf-8", "replace"), table)
    if difference is None:
        return Agreement(store.where, runs, "same", f"to within {RELATIVE:g} of each number")
    return Agreement(store.where, runs, "different", difference)


def _csv_state(csv: Path, source: Provenance) -> str | None:
    if source.csv_sha256 is None:
        return None
    try:
        with open_regular(csv) as file:
            contents = read_whole(file, LARGEST)
    except FileNotFoundError:
        return "missing"
    except OSError:
        return "altered"
    return "as written" if contents and sha256(contents).hexdigest() == source.csv_sha256 else "altered"


def _run_state(run_id: str, sources: Sequence[RunSource], stored: dict[str, RunRow]) -> str:
    """Compare the run with the store; of a run of an older figure only the id is known."""
    run = stored.get(run_id)
    if run is None:
        return "missing"
    for source in sources:
        if source.id == run_id:
            pairs = {
                "spec": (source.spec_hash, run.spec_hash),
                "data": (source.dataset_hash, run.dataset_hash),
                "state": (source.state, run.state.value),
            }
            changes = [f"{name} was {was}, is {now}" for name, (was, now) in pairs.items() if was != now]
            return "; ".join(changes) or "same"
    return "same"


def _collect_again(source: Provenance, store: Store) -> pd.DataFrame:
    """Collect the table of the same figure from the same runs, with the same options."""
    name, options = source.figure, source.options
    try:
        statistic = Statistic(options.get("statistic", Statistic.MEAN_STD))
    except ValueError:
        raise InputError("this ssmail does not know the statistic that it was drawn with") from None
    if name == training_curves.NAME:
        metrics, group_by = options.get("metrics"), options.get("group_by")
        if not isinstance(metrics, list) or not isinstance(group_by, str):
            raise InputError("it does not tell which metrics of which groups it shows")
        runs = store.runs(ids=source.run_ids)
        return training_curves.collect(store, runs, [*map(str, metrics)], group_by, statistic).table()
    if name == varied_runs.NAME:
        given, metrics = options.get("keys"), options.get("metrics")
        if not isinstance(given, list) or not isinstance(metrics, list):
            raise InputError("it does not tell which metrics of which keys it shows")
        runs, keys, names = store.runs(ids=source.run_ids), [*map(str, given)], [*map(str, metrics)]
        with stored_values("its runs"):
            selection = varied_runs.select(store, runs, keys, named=True)
            return ablation.collect(store, selection, keys, names, statistic).table()
    if name == control.NAME:
        with stored_values("its runs"):
            return control.collect_again(store, source, statistic).table()
    if name in (forecast_curves.NAME, forecast_trajectories.NAME):
        with stored_values("its runs"):
            return _collect_forecasts(source, store, statistic)
    if name not in FIGURES:
        raise InputError(f"this ssmail draws no figure {name}")
    module = FIGURES[name]
    environment = source.runs[0].environment if module.has_environment and source.runs else None
    return module.collect(store, source.run_ids, statistic=statistic, environment=environment).table()


def _collect_forecasts(source: Provenance, store: Store, statistic: Statistic) -> pd.DataFrame:
    options = source.options
    if source.figure == forecast_curves.NAME:
        sets = data_sets(store, store.runs(ids=source.run_ids))
        if len(sets) != 1:
            raise InputError("its runs are not on one data set")
        selection, error = sets[0].selection(named=True), str(options.get("error"))
        return forecast_curves.collect(store, sets[0], selection, statistic, error).table()
    windows = options.get("windows")
    if len(source.run_ids) != 1 or not isinstance(windows, list) or not all(type(index) is int for index in windows):
        raise InputError("it does not tell which windows of which run it shows")
    return forecast_trajectories.collect(store, source.run_ids[0], windows).table()
