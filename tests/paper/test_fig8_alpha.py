"""Figure 8: the policy's error and the two terms of the discriminator's loss, and that picture and CSV show them."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ssmail.config.experiments import ablation, ablation_specs
from ssmail.config.names import ENVIRONMENTS
from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic, median_quartiles
from ssmail.paper import fig8_alpha
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

POSITIVE, BOTH = (0.0, 1.0), (-1.0, 1.0)
RESULTS = {POSITIVE: [0.01, 0.02, 0.03], BOTH: [0.001, 0.002, 0.003]}


def lines(axes: Axes) -> dict[str, Line2D]:
    return {str(line.get_gid()): line for line in axes.lines if line.get_gid()}


@pytest.fixture
def runs(vary_alpha: Any) -> dict[Any, list[str]]:
    found: dict[Any, list[str]] = vary_alpha(RESULTS)
    return found


def test_the_ranges_of_experiments_yaml_in_their_order(store: Store, vary_alpha: Any) -> None:
    own = ((-1.0, 0.0, 1.0), (0.0, 1.0, 3.0))
    runs = vary_alpha({own: [0.1], BOTH: [0.2], POSITIVE: [0.3]})
    record = FIGURES["fig8"].collect(store)
    assert [band.label for band in record.errors] == ["[0, 1]", "[-1, 1]", "[[-1, 0, 1], [0, 1, 3]]"]
    assert ablation("alpha").values == (POSITIVE, BOTH)
    assert record.provenance.run_ids == tuple(run for value in (POSITIVE, BOTH, own) for run in runs[value])


def test_mean_and_std_of_the_error_over_seeds(store: Store, runs: dict[Any, list[str]]) -> None:
    record = FIGURES["fig8"].collect(store, statistic=Statistic.MEAN_STD)
    positive, both = record.errors
    assert record.error == "train/mse"
    np.testing.assert_allclose(positive.summary.centre, [0.04, 0.02, 0.02])
    np.testing.assert_allclose(positive.summary.high - positive.summary.centre, [0, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(both.curves[2].values, [0.04, 0.02, 0.003])
    assert record.constant_velocity == 0.0025


def test_the_loss_is_that_on_generated_and_expert_alone(store: Store, runs: dict[Any, list[str]]) -> None:
    for band in FIGURES["fig8"].collect(store).losses:
        for seed, curve in enumerate(band.curves):
            np.testing.assert_allclose(curve.values, np.array([0.5, 0.3, 0.3]) + seed / 10)  # no 9 of the third term
        np.testing.assert_allclose(band.summary.centre, [0.6, 0.4, 0.4])
    (note,) = (text for text in FIGURES["fig8"].collect(store).notes if text.startswith("train/mse above"))
    assert "not the self-supervised term of Eq. 3" in note


def test_a_loss_with_an_unknown_term_is_unknown(store: Store, add_run: Any) -> None:
    terms = {"discriminator/generated": [0.3, np.nan, 0.2], "discriminator/expert": [0.1, 0.1, 0.1]}
    add_run(0, spec=ablation_specs("alpha", "smoke")[BOTH], epochs={"train/mse": [1.0, 0.5, 0.4], **terms})
    (band,) = FIGURES["fig8"].collect(store).losses
    np.testing.assert_allclose(band.curves[0].values, [0.4, np.nan, 0.3])
    assert band.diverged == 0  # a loss of the discriminator is no error


def test_the_first_range_is_compared_with_the_others(store: Store, runs: dict[Any, list[str]]) -> None:
    assert FIGURES["fig8"].collect(store).notes[-1] == (
        "[0, 1] against [-1, 1] at the last epoch: medians 0.02 and 0.002, exact two-sided permutation test on ranks "
        "p = 0.1 (least possible 0.1)."
    )


def test_a_diverged_run_is_counted_and_shown(store: Store, vary_alpha: Any) -> None:
    (_, lost), _ = vary_alpha({POSITIVE: [0.01, None], BOTH: [0.001, 0.002]}).values()
    record = FIGURES["fig8"].collect(store, statistic=Statistic.MEAN_STD)
    assert [band.diverged for band in record.errors] == [1, 0]
    np.testing.assert_array_equal(np.isnan(record.errors[0].summary.centre), [False, True, True])
    figure = fig8_alpha.draw(record)
    upper, lower = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        r"$\alpha$ in [0, 1]: 2 runs, 1 diverged (x)",
        r"$\alpha$ in [-1, 1]: 2 runs",
        "constant velocity (test)",
    ]
    cross = lines(upper)[f"diverged-{lost}"]
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (2, upper.get_ylim()[1])
    assert lines(lower)[f"diverged-{lost}"].get_ydata()[0] == pytest.approx(0.6)  # beside its last value


@pytest.mark.parametrize("statistic", Statistic)
def test_only_diverged_runs_and_runs_without_any_epoch_can_be_drawn(
    store: Store, add_run: Any, statistic: Statistic
) -> None:
    for spec in ablation_specs("alpha", "smoke").values():
        add_run(0, [], RunState.DIVERGED, spec=spec)
    record = FIGURES["fig8"].collect(store, statistic=statistic)
    assert record.constant_velocity is None
    assert len(fig8_alpha.draw(record).axes) == 2


@pytest.mark.parametrize("statistic", Statistic)
def test_picture_and_csv_show_the_record(
    store: Store, runs: dict[Any, list[str]], tmp_path: Path, statistic: Statistic
) -> None:
    record = FIGURES["fig8"].collect(store, statistic=statistic)
    figure = fig8_alpha.draw(record)
    csv = pd.read_csv(save("alpha", record, figure, tmp_path)[-1])
    for axes, metric in zip(figure.axes, ("train/mse", fig8_alpha.LOSS), strict=True):
        rows, drawn = csv[csv["metric"] == metric], lines(axes)
        for run_id, points in rows[rows["kind"] == "run"].groupby("run_id"):
            assert same(drawn.pop(f"run-{run_id}"), points)
        for label, points in rows[rows["kind"] == statistic.centre].groupby("label"):
            assert same(drawn.pop(f"centre-{label}"), points)
        for error in rows.loc[rows["kind"] == "constant velocity", "value"]:
            assert drawn.pop("constant-velocity").get_ydata()[0] == error == 0.0025
        assert drawn == {}
    if statistic is Statistic.MEDIAN_IQR:
        expected = median_quartiles([curve.values for curve in record.losses[0].curves])
        np.testing.assert_array_equal(record.losses[0].summary, expected)


def same(line: Line2D, rows: pd.DataFrame) -> bool:
    """Whether a line has exactly the points of these rows."""
    return np.array_equal(line.get_xdata(), rows["epoch"]) and np.array_equal(line.get_ydata(), rows["value"])


def test_the_axes_are_named_and_free_of_the_legend(store: Store, runs: dict[Any, list[str]]) -> None:
    figure = fig8_alpha.draw(FIGURES["fig8"].collect(store))
    upper, lower = figure.axes
    assert (upper.get_yscale(), lower.get_yscale()) == ("log", "linear")
    assert upper.get_ylabel() == "training squared error\n(squared scaled units)"
    assert lower.get_ylabel().startswith("discriminator loss")
    assert lower.get_xlabel() == "epoch"
    assert lower.get_ylim()[0] == 0
    assert lower.get_ylim()[1] > fig8_alpha.UNDECIDED
    figure.canvas.draw()
    assert not figure.legends[0].get_window_extent().overlaps(upper.get_window_extent())
    assert upper.get_window_extent().height > lower.get_window_extent().height > 60


def test_another_environment_has_its_own_runs_and_error(
    store: Store, runs: dict[Any, list[str]], add_run: Any, vary_alpha: Any
) -> None:
    assert set(fig8_alpha.ERRORS) == set(ENVIRONMENTS)
    elsewhere = vary_alpha({POSITIVE: [0.1], BOTH: [0.2]}, environment="yjunction")
    record = FIGURES["fig8"].collect(store, environment="yjunction")
    assert record.error == "train/mode_mse"
    assert [band.curves[0].run_id for band in record.errors] == [run for (run,) in elsewhere.values()]
    assert record.errors[0].curves[0].values[-1] == 0.1
    assert record.constant_velocity == 0.045
    assert fig8_alpha.draw(record).axes[0].get_ylabel().startswith("training squared error to the nearest lane")
    assert len(FIGURES["fig8"].collect(store).errors[0].curves) == 3  # those of mocap are still its own


def test_what_cannot_be_drawn_is_said(store: Store, add_run: Any) -> None:
    with pytest.raises(NoRuns, match="no run of the ablation alpha on mocap; run `ssmail ablate alpha --profile quick"):
        FIGURES["fig8"].collect(store)
    with pytest.raises(NoRuns, match="on yjunction; run `ssmail ablate alpha --env yjunction --profile quick --seeds"):
        FIGURES["fig8"].collect(store, environment="yjunction")
    run = add_run(0, state=RunState.INTERRUPTED, spec=ablation_specs("alpha", "smoke")[BOTH])
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no train/mse yet; "):
        FIGURES["fig8"].collect(store, [run])
    half = add_run(1, spec=ablation_specs("alpha", "smoke")[BOTH], epochs={"train/mse": [1.0, 0.5, 0.4]})
    with pytest.raises(InputError, match=rf"^run {half[:8]} \(finished\) has no discriminator/generated yet; "):
        FIGURES["fig8"].collect(store, [half])
