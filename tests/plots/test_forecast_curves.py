"""`ssmail plot forecast`: what is drawn is what is stored, and what the runs of a method have in common."""

import math

import numpy as np
import pytest

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.plots.data_sets import data_sets
from ssmail.plots.forecast_curves import ForecastRecord, collect, draw
from ssmail.store import RunState, Store
from tests.paper.handmade_arrays import STEPS

from .conftest import AddRun

STEP = np.arange(1.0, STEPS + 1)


def record(store: Store, **options: object) -> ForecastRecord:
    (data,) = data_sets(store, store.runs())
    return collect(store, data, data.selection(), **options)  # type: ignore[arg-type]


def test_the_mean_and_its_interval_over_seeds(store: Store, add_trajectories: AddRun) -> None:
    """Of two values a and b the 95 % interval is mean -+ 12.706 |a - b| / 2."""
    for seed, level in enumerate((0.001, 0.003)):
        add_trajectories(seed, level)
    table = record(store).table()
    mean = table[table["kind"] == "mean"]
    np.testing.assert_allclose(mean["value"], 0.002 * (1 + 0.5 * STEP))
    np.testing.assert_allclose(mean["high"] - mean["value"], 12.7062 * 0.001 * (1 + 0.5 * STEP), rtol=1e-5)
    of_std = record(store, statistic=Statistic.MEAN_STD).table()
    spread = (of_std["high"] - of_std["value"])[of_std["kind"] == "mean"]
    np.testing.assert_allclose(spread, math.sqrt(2) * 0.001 * (1 + 0.5 * STEP))


@pytest.mark.parametrize("environment", ["mocap", "trajectories"])
def test_what_is_drawn_is_what_is_stored(
    store: Store, add_forecast: AddRun, add_trajectories: AddRun, environment: str
) -> None:
    add = add_forecast if environment == "mocap" else add_trajectories
    run = add(level=0.002, method="dnri")
    figure = draw(record(store))
    (axes,) = figure.axes
    lines = {line.get_gid(): line.get_ydata() for line in axes.lines}
    np.testing.assert_allclose(lines[f"run-{run}"], store.array(run, "test/mse"))
    np.testing.assert_allclose(lines["centre-dnri"], store.array(run, "test/mse"))
    np.testing.assert_allclose(lines["constant velocity"], 0.001 * STEP)
    np.testing.assert_allclose(lines["copy-last"], 0.004 * STEP)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["dnri: 1 run", "constant velocity", "copy-last"]
    assert axes.get_ylabel() == "test squared error\n(squared scaled units)"


@pytest.mark.parametrize(("level", "scale"), [(0.002, "linear"), (0.0001, "log")])
def test_the_scale_follows_from_what_is_shown(store: Store, add_trajectories: AddRun, level: float, scale: str) -> None:
    """The references reach 0.02: 6.7 times the lowest error of the one run, and 133 times that of the other."""
    add_trajectories(level=level)
    (axes,) = draw(record(store)).axes
    assert axes.get_yscale() == scale
    low, high = axes.get_ylim()
    assert bool(low == 0) is (scale == "linear")
    assert high > 0.02


def test_a_diverged_run_is_a_cross_and_leaves_no_mean(store: Store, add_trajectories: AddRun) -> None:
    add_trajectories(0)
    gone = add_trajectories(1, state=RunState.DIVERGED)
    found = record(store)
    assert np.isnan(found.bands[0].summary.centre).all()
    figure = draw(found)
    assert f"diverged-{gone}" in {line.get_gid() for line in figure.axes[0].lines}
    assert "ssail: 2 runs, 1 diverged (x)" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert np.isfinite(record(store, statistic=Statistic.MEDIAN_IQR).bands[0].lowest).all()


def test_the_distance_in_units_of_the_data(store: Store, add_trajectories: AddRun) -> None:
    distances = {f"{what}/distance": factor * STEP for what, factor in (("test", 2), ("test_copy_last", 3))}
    add_trajectories(extra=distances)
    found = record(store, error="distance")
    assert found.stem == "forecast_flock_distance"
    assert list(found.references) == ["copy-last"]
    (axes,) = draw(found).axes
    assert axes.get_ylabel() == "test distance to the true position\n(raw units of length)"
    np.testing.assert_allclose(found.bands[0].summary.centre, 2 * STEP)
    with pytest.raises(InputError, match="unknown error 'dist'; did you mean distance"):
        record(store, error="dist")


def test_an_error_that_was_not_stored_is_missed(store: Store, add_trajectories: AddRun) -> None:
    add_trajectories()
    with pytest.raises(InputError, match="has no array 'test/distance'"):
        record(store, error="distance")


def test_runs_that_were_tested_in_different_ways_are_not_compared(store: Store, add_trajectories: AddRun) -> None:
    add_trajectories()
    add_trajectories(method="dnri", overrides=["forecast.observed=7"])
    with pytest.raises(InputError, match=r"differ in forecast.observed, so forecast cannot compare"):
        record(store)
