"""Figure 7: errors over predicted steps and their slopes, by hand; and that picture and CSV show the record."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic, mean_interval, median_quartiles
from ssmail.paper import fig7_noise
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

STEPS = 6
LATE = range(STEPS // 2 + 1, STEPS + 1)  # 4, 5, 6


def lines(axes: Axes) -> dict[str, Line2D]:
    return {str(line.get_gid()): line for line in axes.lines if line.get_gid()}


@pytest.fixture
def runs(add_forecast: Any) -> list[str]:
    """Three seeds of each method; the errors grow by half of `level` each step, and noise triples them."""
    levels = {"ssail": (0.001, 0.002, 0.003), "dnri": (0.004, 0.004, 0.010)}
    return [
        add_forecast(seed, level, method, steps=STEPS)
        for method, found in levels.items()
        for seed, level in enumerate(found)
    ]


def test_mean_and_std_over_seeds_at_every_step(store: Store, runs: list[str]) -> None:
    record = FIGURES["fig7"].collect(store)
    assert record.provenance.run_ids == tuple(runs)
    assert [panel.condition for panel in record.panels] == ["clean", "noisy"]
    growth = 1 + np.arange(1, STEPS + 1) / 2
    for panel, factor in zip(record.panels, (1, 3), strict=True):
        ssail, dnri = panel.bands
        assert [shown.label for shown in panel.bands] == ["ssail", "dnri"]
        np.testing.assert_array_equal(ssail.epochs, np.arange(1, STEPS + 1))
        np.testing.assert_allclose(ssail.curves[2].values, factor * 0.003 * growth)
        np.testing.assert_allclose(ssail.summary.centre, factor * 0.002 * growth)
        np.testing.assert_allclose(ssail.summary.high - ssail.summary.centre, factor * 0.001 * growth)
        np.testing.assert_allclose(dnri.summary.centre, factor * 0.006 * growth)
    np.testing.assert_allclose(record.panels[0].reference, 0.001 * np.arange(1, STEPS + 1))
    np.testing.assert_allclose(record.panels[1].reference, 0.002 * np.arange(1, STEPS + 1))
    assert record.noise == 0.05


def test_slopes_are_those_of_the_last_half(store: Store, add_forecast: Any) -> None:
    bent = np.array([9.0, 7.0, 8.0, 1.0, 2.0, 3.0]) / 1000  # rises by 0.001 a step in the last half alone
    add_forecast(0, 0.002, steps=STEPS, errors={"test/mse": bent})
    add_forecast(1, 0.006, steps=STEPS)  # straight: 0.003 a step
    record = FIGURES["fig7"].collect(store)
    (clean,), (noisy,) = (panel.slopes for panel in record.panels)
    np.testing.assert_allclose(clean.runs, [0.001, 0.003])
    np.testing.assert_allclose(noisy.runs, [0.003, 0.009])
    np.testing.assert_allclose(clean.mean.centre, 0.002)
    np.testing.assert_allclose(clean.mean, mean_interval(np.array([0.001, 0.003])))
    np.testing.assert_allclose([panel.reference_slope for panel in record.panels], [0.001, 0.002])
    assert record.notes[-2].startswith(
        "clean: slope over steps 4-6, squared scaled units per step (mean of the runs, 95%"
    )
    assert record.notes[-2].endswith("ssail 0.002 (-0.011 to 0.015), constant velocity 0.001.")


def test_the_slope_is_by_least_squares(store: Store, add_forecast: Any) -> None:
    errors = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 4.0, 2.0])
    add_forecast(0, steps=8, errors={"test/mse": errors})
    (slopes,) = FIGURES["fig7"].collect(store).panels[0].slopes
    # steps 5 to 8, centred -1.5 -0.5 0.5 1.5: (-1.5 - 0.5 + 0.5 * 4 + 1.5 * 2) / (2.25 + 0.25 + 0.25 + 2.25)
    np.testing.assert_allclose(slopes.runs, [3.0 / 5.0])
    assert "ssail 0.6 (one run), constant velocity" in FIGURES["fig7"].collect(store).notes[-2]


def test_the_statistic_can_be_chosen(store: Store, runs: list[str]) -> None:
    record = FIGURES["fig7"].collect(store, statistic=Statistic.MEDIAN_IQR)
    (dnri,) = (shown for shown in record.panels[0].bands if shown.label == "dnri")
    np.testing.assert_allclose(dnri.summary, median_quartiles([curve.values for curve in dnri.curves]))
    assert "median" in set(record.table()["kind"])
    assert "median" in fig7_noise.draw(record).legends[0].get_title().get_text()


def test_a_diverged_run_takes_the_mean_with_it_and_is_shown(
    store: Store, runs: list[str], add_forecast: Any, tmp_path: Path
) -> None:
    lost = add_forecast(3, method="dnri", state=RunState.DIVERGED)
    record = FIGURES["fig7"].collect(store)
    figure = fig7_noise.draw(record)
    for axes, panel in zip(figure.axes, record.panels, strict=True):
        ssail, dnri = panel.bands
        assert (ssail.diverged, dnri.diverged) == (0, 1)
        assert np.isnan(dnri.summary.centre).all()  # never the mean of the survivors
        assert np.isfinite(ssail.summary.centre).all()
        assert np.isnan(panel.slopes[1].mean.centre)
        np.testing.assert_array_equal(np.isnan(panel.slopes[1].runs), [False, False, False, True])
        cross = lines(axes)[f"diverged-{lost}"]
        assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (1, axes.get_ylim()[1])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "ssail: 3 runs",
        "dnri: 4 runs, 1 diverged (x)",
        "constant velocity",
    ]
    assert all("dnri none (1 of 4 runs without finite errors)" in note for note in record.notes[-2:])
    median = FIGURES["fig7"].collect(store, statistic=Statistic.MEDIAN_IQR).panels[0].bands[1]
    np.testing.assert_allclose(median.summary.centre[0], 1.5 * 0.007)  # of 0.004, 0.004, 0.010 and infinity
    assert (record.table()["kind"] == "diverged").sum() == 2


def test_predictions_that_explode_under_noise_alone(store: Store, add_forecast: Any) -> None:
    exploded = np.array([0.01, 0.1, np.inf, np.nan])
    run = add_forecast(0, steps=4, errors={"test_noisy/mse": exploded})
    add_forecast(1, steps=4)
    clean, noisy = FIGURES["fig7"].collect(store).panels
    assert [panel.bands[0].diverged for panel in (clean, noisy)] == [0, 1]
    np.testing.assert_array_equal(np.isfinite(noisy.bands[0].summary.centre), [True, True, False, False])
    figure = fig7_noise.draw(FIGURES["fig7"].collect(store))
    assert f"diverged-{run}" not in lines(figure.axes[0])
    assert lines(figure.axes[1])[f"diverged-{run}"].get_xdata()[0] == 3
    assert figure.legends[0].get_texts()[0].get_text() == "ssail: 2 runs, 1 diverged (x)"


@pytest.mark.parametrize("statistic", Statistic)
def test_only_diverged_runs_can_be_drawn(store: Store, add_forecast: Any, statistic: Statistic) -> None:
    add_forecast(0, state=RunState.DIVERGED)
    record = FIGURES["fig7"].collect(store, statistic=statistic)
    figure = fig7_noise.draw(record)
    assert len(figure.axes) == 2
    assert list(record.table()["kind"]) == ["diverged", "run slope", "mean slope"] * 2


@pytest.mark.parametrize("statistic", Statistic)
def test_picture_and_csv_show_the_record(store: Store, runs: list[str], tmp_path: Path, statistic: Statistic) -> None:
    record = FIGURES["fig7"].collect(store, statistic=statistic)
    figure = fig7_noise.draw(record)
    csv = pd.read_csv(save("noise", record, figure, tmp_path)[-1])
    for axes, (_, rows) in zip(figure.axes, csv.groupby("condition"), strict=True):
        drawn = lines(axes)
        for run_id, points in rows[rows["kind"] == "run"].groupby("run_id"):
            assert same(drawn.pop(f"run-{run_id}"), points)
        for label, points in rows[rows["kind"] == statistic.centre].groupby("label"):
            assert same(drawn.pop(f"centre-{label}"), points)
        reference = drawn.pop("constant-velocity")
        assert same(reference, rows[rows["kind"] == "constant velocity"])
        assert reference.get_linewidth() < 1
        assert drawn == {}
        slopes = rows[rows["kind"] == "run slope"]
        assert list(slopes["run_id"]) == runs
        assert set(slopes["step"]) == {LATE[0]}
        for label, found in slopes.groupby("label"):
            mean = rows[(rows["kind"] == "mean slope") & (rows["label"] == label)]
            np.testing.assert_allclose(mean[["value", "low", "high"]].to_numpy()[0], mean_interval(found["value"]))
        assert (rows["kind"] == "constant velocity slope").sum() == 1


def same(line: Line2D, rows: pd.DataFrame) -> bool:
    """Whether a line has exactly the points of these rows."""
    return np.array_equal(line.get_xdata(), rows["step"]) and np.array_equal(line.get_ydata(), rows["value"])


def test_the_axes_are_named_linear_from_zero_and_free_of_the_legend(store: Store, runs: list[str]) -> None:
    figure = fig7_noise.draw(FIGURES["fig7"].collect(store))
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "clean input",
        "noisy input (std 0.05 scaled units)",
    ]
    assert figure.axes[-1].get_xlabel() == "predicted step"
    assert "scaled units²" in figure.get_supylabel()
    figure.canvas.draw()
    for axes, highest in zip(figure.axes, (0.04, 0.12), strict=True):
        assert axes.get_yscale() == "linear"
        np.testing.assert_allclose(axes.get_ylim(), (0, 1.05 * highest))
        assert [int(tick) for tick in axes.get_xticks()] == [1, 2, 3, 4, 6]
        for label, tick in zip(axes.get_yticklabels(), axes.get_yticks(), strict=True):
            assert float(label.get_text()) == pytest.approx(1000 * tick)
        assert not figure.legends[0].get_window_extent().overlaps(axes.get_window_extent())
        assert axes.get_window_extent().height > 60


def test_a_run_far_above_the_others_does_not_flatten_them(store: Store, runs: list[str], add_forecast: Any) -> None:
    add_forecast(3, 100.0, method="dnri", steps=STEPS)
    record = FIGURES["fig7"].collect(store)
    clean = record.panels[0]
    assert clean.end == pytest.approx(fig7_noise.SCALE_LIMIT * 0.007 * 4)  # the median of dnri's peaks
    assert fig7_noise.draw(record).axes[0].get_ylim()[1] == clean.end
    assert "clean: dnri: 1 of the runs rise above 0.112, where the scale ends." in record.notes
    assert record.table()["value"].max() == 3 * 100 * 4


def test_a_reference_far_above_the_methods_does_not_flatten_them(store: Store, runs: list[str]) -> None:
    """With noise constant velocity can be a hundred times worse; then it is told, and does not set the scale."""
    panel = FIGURES["fig7"].collect(store).panels[1]
    assert not panel.reference_leaves
    far = replace(panel, reference=1000 * panel.reference)
    assert far.reference_leaves
    assert far.end == replace(panel, reference=panel.reference[:0]).end < far.reference.max()
    highest = far.reference.max()
    told = f"noisy: constant velocity rises to {highest:.3g}, beyond {far.end:.3g}, where the scale ends."
    assert fig7_noise._panel_notes(far)[0] == told


def test_runs_that_were_tested_in_different_ways_are_not_compared(store: Store, add_forecast: Any) -> None:
    first, second = add_forecast(0), add_forecast(0, method="dnri", overrides=["forecast.noise=0.1"])
    with pytest.raises(InputError, match=rf"^runs {first[:8]} and {second[:8]} differ in forecast\.noise, so fig7 "):
        FIGURES["fig7"].collect(store, [first, second])
    history = add_forecast(0, overrides=["forecast.noise_on=history"])
    assert "on the observed history alone" in FIGURES["fig7"].collect(store, [history]).notes[0]
    assert "on every state that is read" in FIGURES["fig7"].collect(store, [first]).notes[0]


def test_unfinished_and_absent_runs_are_said(store: Store, add_run: Any, add_forecast: Any) -> None:
    with pytest.raises(NoRuns, match="run `ssmail train --method ssail --env mocap --profile quick --seeds 0-4`"):
        FIGURES["fig7"].collect(store)
    other = add_run(0)
    with pytest.raises(InputError, match=r"is of yjunction, but fig7 draws mocap; leave it out\.$"):
        FIGURES["fig7"].collect(store, [other])
    run = add_forecast(0, state=RunState.INTERRUPTED)
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no test errors; "):
        FIGURES["fig7"].collect(store, [run])
