"""Figure 6: every seed, centre and spread of each beta, and diverged runs, in the record, the picture and the CSV."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from ssmail.config.experiments import ablation_specs
from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.paper import fig6_beta
from ssmail.paper.results import FIGURES
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

RESULTS = {0.0: [0.4, 0.2, None], 0.05: [0.01, 0.02, 0.03], 1.0: [0.1, 0.1, 0.4]}


@pytest.fixture
def runs(ablate: Any) -> dict[float, list[str]]:
    found: dict[float, list[str]] = ablate("beta", RESULTS)
    return found


def lines(figure: Any, panel: int = 0) -> dict[str, Line2D]:
    return {str(line.get_gid()): line for line in figure.axes[panel].lines if line.get_gid()}


def test_mean_and_std_are_over_all_seeds_and_lost_with_one(store: Store, runs: dict[float, list[str]]) -> None:
    record = FIGURES["fig6"].collect(store, statistic=Statistic.MEAN_STD)
    first, second, third = record.columns
    assert [column.value for column in record.columns] == [0.0, 0.05, 1.0]
    assert [column.run_ids for column in record.columns] == [tuple(found) for found in runs.values()]
    assert record.constant_velocity == 0.045
    np.testing.assert_allclose(second.error_summary, [0.02, 0.01, 0.03])
    np.testing.assert_allclose(third.error_summary.centre, 0.2)
    np.testing.assert_array_equal(first.error, [0.4, 0.2, np.inf])
    assert np.isnan(first.error_summary.centre)  # not 0.3, the mean of the survivors
    assert np.isnan(first.balance_summary.centre)
    assert [column.diverged for column in record.columns] == [1, 0, 0]
    assert record.notes[-1] == (
        "runs without a finite test error, of beta 0 (1 of 3), count as infinite; a mean has no number there."
    )


def test_the_median_counts_a_diverged_run_as_the_worst(store: Store, runs: dict[float, list[str]]) -> None:
    record = FIGURES["fig6"].collect(store, statistic=Statistic.MEDIAN_IQR)
    assert [float(column.error_summary.centre) for column in record.columns] == [0.4, 0.02, 0.1]
    assert record.columns[0].error_summary.high == np.inf
    assert np.isnan(record.columns[0].balance_summary.centre)  # its lane balance is unknown, not bad


def test_an_error_that_is_not_finite_counts_as_diverged(store: Store, add_run: Any) -> None:
    spec = ablation_specs("beta", "smoke", values=[0.0])[0.0]
    add_run(0, spec=spec, final={"test/mode_mse": np.nan})
    add_run(1, spec=spec, final={"test/mode_mse": 0.1})
    (column,) = FIGURES["fig6"].collect(store).columns
    assert column.diverged == 1
    np.testing.assert_array_equal(column.balance, [0.25, 0.25])
    assert column.balance_summary.centre == 0.25


@pytest.mark.parametrize("statistic", Statistic)
def test_picture_and_csv_show_the_record(
    store: Store, runs: dict[float, list[str]], tmp_path: Path, statistic: Statistic
) -> None:
    record = FIGURES["fig6"].collect(store, statistic=statistic)
    figure = fig6_beta.draw(record)
    csv = pd.read_csv(save("beta", record, figure, tmp_path)[-1])
    upper, lower = figure.axes
    centres = csv[csv["kind"] == statistic.centre]
    means = csv[csv["kind"] == "mean"]
    for axes, name in ((upper, "mode_mse"), (lower, "lane_balance")):
        line = lines(figure, figure.axes.index(axes))["centres"]
        np.testing.assert_array_equal(line.get_ydata(), centres[name])
        np.testing.assert_allclose(line.get_xdata(), np.arange(3) + fig6_beta.ASIDE)
    for index, (value, rows) in enumerate(csv[csv["kind"] == "run"].groupby("beta")):
        points, finite = lines(figure)[f"runs-{value:g}"], rows[np.isfinite(rows["mode_mse"])]
        np.testing.assert_array_equal(points.get_ydata(), finite["mode_mse"])
        np.testing.assert_array_equal(lines(figure, 1)[f"balances-{value:g}"].get_ydata(), rows["lane_balance"])
        assert np.abs(points.get_xdata() - index).max() < 0.5
        crosses = lines(figure).get(f"diverged-{value:g}")
        assert (len(crosses.get_xdata()) if crosses else 0) == len(rows) - len(finite)
    assert list(lines(figure)["diverged-0"].get_ydata()) == [upper.get_ylim()[1]]
    np.testing.assert_allclose(means["mode_mse"], [np.nan, 0.02, 0.2])
    if statistic is Statistic.MEDIAN_IQR:
        np.testing.assert_array_equal(lines(figure)["means"].get_ydata(), means["mode_mse"])
    else:
        assert "means" not in lines(figure)
    (reference,) = csv.loc[csv["kind"] == "constant velocity", "mode_mse"]
    assert lines(figure)["constant-velocity"].get_ydata()[0] == reference == 0.045


def test_the_axes_are_named_and_free_of_the_legend(store: Store, runs: dict[float, list[str]]) -> None:
    figure = fig6_beta.draw(FIGURES["fig6"].collect(store))
    upper, lower = figure.axes
    assert [label.get_text() for label in lower.get_xticklabels()] == ["0", ".05", "1"]
    assert "evenly spaced" in lower.get_xlabel()
    assert upper.get_ylabel() == "test squared error to the\nnearest lane (scaled units²)"
    assert upper.get_yscale() == "log"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "one run",
        "median and quartiles",
        "mean",
        "diverged, 1 of 9 runs",
        "constant velocity (test)",
    ]
    figure.canvas.draw()
    assert not figure.legends[0].get_window_extent().overlaps(upper.get_window_extent())
    assert upper.get_window_extent().height > lower.get_window_extent().height > 30


@pytest.mark.parametrize("statistic", Statistic)
def test_nothing_leaves_the_axis_and_centres_stand_beside_their_runs(
    store: Store, ablate: Any, statistic: Statistic
) -> None:
    ablate("beta", {0.0: [0.4, 0.002, 0.003], 1.0: [0.1, 0.1, 0.4]})  # here mean - std is negative
    figure = fig6_beta.draw(FIGURES["fig6"].collect(store, statistic=statistic))
    upper = figure.axes[0]
    low, high = upper.get_ylim()
    (bars,) = (item for item in upper.collections if isinstance(item, LineCollection))
    ends = np.concatenate([segment[:, 1] for segment in bars.get_segments()])
    assert low < ends.min()
    assert ends.max() < high
    named = lines(figure)
    for index, label in enumerate(("0", "1")):
        assert named[f"runs-{label}"].get_xdata().max() < index < named["centres"].get_xdata()[index]


def test_a_single_run_and_only_diverged_ones_can_be_drawn(store: Store, ablate: Any) -> None:
    ablate("beta", {0.0: [None], 1.0: [0.1]})
    for statistic in Statistic:
        figure = fig6_beta.draw(FIGURES["fig6"].collect(store, statistic=statistic))
        assert len(lines(figure)["diverged-0"].get_xdata()) == 1


def test_an_unfinished_run_is_refused(store: Store, add_run: Any) -> None:
    run = add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no test error; "):
        FIGURES["fig6"].collect(store, [run])
