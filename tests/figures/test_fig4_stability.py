"""Figure 4: the record's numbers by hand, and that the picture and the CSV show the record."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.errors import InputError
from ssmail.figures import fig4_stability, save
from ssmail.store import RunState, Store


def lines(figure: Figure) -> dict[str, Line2D]:
    """The lines that carry a name."""
    return {str(line.get_gid()): line for line in figure.axes[0].lines if line.get_gid()}


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_mean_and_std_are_over_all_seeds(store: Store, add_run: Any) -> None:
    runs = [add_run(0, [0.04, 0.02, 0.01]), add_run(1, [0.06, 0.02, 0.04])]
    record = fig4_stability.collect(store)
    (band,) = record.bands
    assert [curve.run_id for curve in band.curves] == runs
    np.testing.assert_array_equal(band.curves[1].error, [0.06, 0.02, 0.04])
    np.testing.assert_array_equal(band.epochs, [1, 2, 3])
    np.testing.assert_allclose(band.mean, [0.05, 0.02, 0.025])
    np.testing.assert_allclose(band.std, [0.02 / np.sqrt(2), 0, 0.03 / np.sqrt(2)])
    assert record.constant_velocity == 0.045
    assert band.diverged == 0
    assert record.provenance.run_ids == tuple(runs)


def test_a_single_run_has_no_std(store: Store, add_run: Any) -> None:
    add_run(0, [0.04, 0.02])
    (band,) = fig4_stability.collect(store).bands
    np.testing.assert_array_equal(band.mean, [0.04, 0.02])
    assert np.isnan(band.std).all()
    assert legend(fig4_stability.draw(fig4_stability.collect(store)))[0] == "ssail: one run"


@pytest.mark.parametrize(
    ("errors", "epoch"), [([0.5, np.inf], 2), ([0.5, np.nan, 0.4], 2), ([0.5, 0.6], 3), ([np.nan], 1), ([], 1)]
)
def test_a_diverged_seed_stays_in_the_statistic_and_is_marked(
    store: Store, add_run: Any, errors: list[float], epoch: int
) -> None:
    healthy = add_run(0, [0.04, 0.02, 0.01])
    lost = add_run(1, errors, RunState.DIVERGED)
    record = fig4_stability.collect(store)
    (band,) = record.bands
    assert [curve.diverged_at for curve in band.curves] == [None, epoch]
    known = [e <= len(errors) and np.isfinite(errors[e - 1]) for e in (1, 2, 3)]
    np.testing.assert_array_equal(np.isfinite(band.mean), known)  # never the mean of the survivors alone
    figure = fig4_stability.draw(record)
    assert legend(figure)[0] == "ssail: mean ± std of 2 runs, 1 diverged (x)"
    cross = lines(figure)[f"diverged-{lost}"]
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (epoch, figure.axes[0].get_ylim()[1])
    assert f"diverged-{healthy}" not in lines(figure)
    assert list(record.table().query("kind == 'diverged'")["epoch"]) == [epoch]


def test_only_diverged_seeds_can_be_drawn(store: Store, add_run: Any) -> None:
    add_run(0, [], RunState.DIVERGED)
    record = fig4_stability.collect(store)
    assert record.constant_velocity is None
    assert legend(fig4_stability.draw(record)) == ["ssail: one run, 1 diverged (x)"]


def test_the_csv_is_what_is_drawn(store: Store, add_run: Any, tmp_path: Path) -> None:
    add_run(0, [0.04, 0.02, 0.01])
    add_run(1, [0.06, 0.03, 0.005])
    add_run(2, [0.5, 0.7], RunState.DIVERGED)
    record = fig4_stability.collect(store)
    figure = fig4_stability.draw(record)
    csv = pd.read_csv(save("fig4", record, figure, tmp_path)[-1])
    drawn = lines(figure)
    assert set(csv["kind"]) == {"run", "mean", "diverged", "constant velocity"}
    for run_id, rows in csv[csv["kind"] == "run"].groupby("run_id"):
        assert same(drawn.pop(f"run-{run_id}"), rows)
    mean = csv[csv["kind"] == "mean"]
    assert same(drawn.pop("mean-ssail"), mean)
    for run_id, rows in csv[csv["kind"] == "diverged"].groupby("run_id"):
        np.testing.assert_array_equal(drawn.pop(f"diverged-{run_id}").get_xdata(), rows["epoch"])
    (reference,) = csv.loc[csv["kind"] == "constant velocity", "mode_mse"]
    assert drawn.pop("constant-velocity").get_ydata() == [reference, reference]
    assert drawn == {}
    (area,) = (item for item in figure.axes[0].collections if isinstance(item, PolyCollection))
    shown = mean.dropna(subset=["mode_mse"])
    assert list(shown["epoch"]) == [1, 2]
    top = {x: max(y for other, y in area.get_paths()[0].vertices if other == x) for x in shown["epoch"]}
    np.testing.assert_allclose([top[x] for x in shown["epoch"]], shown["mode_mse"] + shown["std"])


def same(line: Line2D, rows: pd.DataFrame) -> bool:
    """Whether a line has exactly the points of these rows."""
    x, y = line.get_xdata(), line.get_ydata()
    return np.array_equal(x, rows["epoch"]) and np.array_equal(y, rows["mode_mse"], equal_nan=True)


def test_the_axes_are_named_logarithmic_and_free_of_the_legend(store: Store, add_run: Any) -> None:
    add_run(0)
    figure = fig4_stability.draw(fig4_stability.collect(store))
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    assert axes.get_xlabel() == "epoch"
    assert "squared scaled units" in axes.get_ylabel()
    assert legend(figure) == ["ssail: one run", "constant velocity (test)"]
    figure.canvas.draw()
    assert not figure.legends[0].get_window_extent().overlaps(axes.get_window_extent())
    assert figure.get_size_inches()[0] == pytest.approx(3.4)


def test_ids_draw_unfinished_runs_and_keep_specs_apart(store: Store, add_run: Any) -> None:
    ids = [add_run(0), add_run(0, [0.3], RunState.RUNNING, overrides=["sac.gamma=0.5"])]
    record = fig4_stability.collect(store, ids)
    assert [len(band.curves) for band in record.bands] == [1, 1]
    colours = [lines(fig4_stability.draw(record))[f"mean-{band.label}"].get_color() for band in record.bands]
    assert colours[0] != colours[1]
    silent = add_run(1, [], RunState.RUNNING)
    with pytest.raises(InputError, match=rf"^run {silent[:8]} \(running\) has no train/mode_mse yet; "):
        fig4_stability.collect(store, [silent])
