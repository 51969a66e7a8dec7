"""Figure 4: the record's numbers by hand, and that the picture and the CSV show the record."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic, mean_interval, median_quartiles
from ssmail.paper import fig4_stability
from ssmail.paper.fig4_stability import StabilityRecord
from ssmail.paper.results import FIGURES
from ssmail.plots import style
from ssmail.store import RunState, Store
from tests.paper.figure_files import save


def lines(axes: Axes) -> dict[str, Line2D]:
    """The lines that carry a name."""
    return {str(line.get_gid()): line for line in axes.lines if line.get_gid()}


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def means(store: Store) -> StabilityRecord:
    record = FIGURES["fig4"].collect(store, statistic=Statistic.MEAN_STD)
    assert isinstance(record, StabilityRecord)
    return record


def drawn(store: Store) -> Figure:
    return fig4_stability.draw(FIGURES["fig4"].collect(store))


def test_mean_and_std_are_over_all_seeds(store: Store, add_run: Any) -> None:
    runs = [add_run(0, [0.04, 0.02, 0.01]), add_run(1, [0.06, 0.02, 0.04])]
    record = means(store)
    (band,) = record.bands
    assert [curve.run_id for curve in band.curves] == runs
    np.testing.assert_array_equal(band.curves[1].values, [0.06, 0.02, 0.04])
    np.testing.assert_array_equal(band.epochs, [1, 2, 3])
    np.testing.assert_allclose(band.summary.centre, [0.05, 0.02, 0.025])
    np.testing.assert_allclose(band.summary.high - band.summary.centre, [0.02 / np.sqrt(2), 0, 0.03 / np.sqrt(2)])
    assert record.constant_velocity == 0.045
    assert band.diverged == 0
    assert record.provenance.run_ids == tuple(runs)


def test_the_statistic_can_be_chosen(store: Store, add_run: Any) -> None:
    errors = np.array([[0.04, 0.02], [0.06, 0.03], [0.5, 0.01]])
    for seed, values in enumerate(errors):
        add_run(seed, list(values))
    for statistic, expected in ((Statistic.MEDIAN_IQR, median_quartiles), (Statistic.MEAN_CI, mean_interval)):
        record = FIGURES["fig4"].collect(store, statistic=statistic)
        np.testing.assert_array_equal(record.bands[0].summary, expected(errors))
        assert statistic.words in fig4_stability.draw(record).legends[0].get_title().get_text()
    assert "median" in set(FIGURES["fig4"].collect(store, statistic=Statistic.MEDIAN_IQR).table()["kind"])


def test_a_single_run_has_no_band(store: Store, add_run: Any) -> None:
    add_run(0, [0.04, 0.02])
    for statistic in (Statistic.MEAN_STD, Statistic.MEAN_CI):
        record = FIGURES["fig4"].collect(store, statistic=statistic)
        np.testing.assert_array_equal(record.bands[0].summary.centre, [0.04, 0.02])
        figure = fig4_stability.draw(record)
        assert legend(figure)[0] == "ssail: 1 run"
        assert band_of(figure.axes[0]) == {}


def band_of(axes: Axes, method: str = "ssail") -> dict[float, tuple[float, float]]:
    """The lower and upper end of the drawn band, by epoch."""
    colour = to_rgb(style.METHODS[method].colour)
    areas = [item for item in axes.collections if isinstance(item, PolyCollection)]
    (area,) = (item for item in areas if tuple(item.get_facecolor()[0][:3]) == colour)
    points = [tuple(point) for path in area.get_paths() for point in path.vertices]
    return {x: (min(y for at, y in points if at == x), max(y for at, y in points if at == x)) for x, _ in points}


@pytest.mark.parametrize(
    ("errors", "epoch"), [([0.5, np.inf], 2), ([0.5, np.nan, 0.4], 2), ([0.5, 0.6], 3), ([np.nan], 1), ([], 1)]
)
def test_a_diverged_seed_stays_in_the_statistic_and_is_marked(
    store: Store, add_run: Any, errors: list[float], epoch: int
) -> None:
    healthy = add_run(0, [0.04, 0.02, 0.01])
    lost = add_run(1, errors, RunState.DIVERGED)
    record = means(store)
    (band,) = record.bands
    assert [curve.diverged_at for curve in band.curves] == [None, epoch]
    known = [e <= len(errors) and np.isfinite(errors[e - 1]) for e in (1, 2, 3)]
    np.testing.assert_array_equal(np.isfinite(band.summary.centre), known)  # never the mean of the survivors alone
    figure = fig4_stability.draw(record)
    assert legend(figure)[0] == "ssail: 2 runs, 1 diverged (x)"
    (axes,) = figure.axes
    cross = lines(axes)[f"diverged-{lost}"]
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (epoch, axes.get_ylim()[1])
    assert f"diverged-{healthy}" not in lines(axes)
    assert list(record.table().query("kind == 'diverged'")["epoch"]) == [epoch]


def test_the_median_goes_on_where_the_mean_is_lost(store: Store, add_run: Any) -> None:
    for seed, level in enumerate((0.01, 0.02, 0.03)):
        add_run(seed, [level] * 3)
    add_run(3, [0.5], RunState.DIVERGED)
    add_run(4, [0.04, 0.04], RunState.INTERRUPTED)  # unfinished: not drawn by default
    (band,) = FIGURES["fig4"].collect(store, statistic=Statistic.MEDIAN_IQR).bands
    np.testing.assert_allclose(band.summary.centre, [0.025, 0.025, 0.025])  # of 0.01, 0.02, 0.03 and infinity
    everything = [run.id for run in store.runs()]
    (band,) = FIGURES["fig4"].collect(store, everything, statistic=Statistic.MEDIAN_IQR).bands
    np.testing.assert_allclose(band.summary.centre, [0.03, 0.03, np.nan])  # what the unfinished run does is unknown


def test_only_diverged_seeds_can_be_drawn(store: Store, add_run: Any) -> None:
    add_run(0, [], RunState.DIVERGED)
    record = FIGURES["fig4"].collect(store)
    assert record.constant_velocity is None
    for statistic in Statistic:
        figure = fig4_stability.draw(FIGURES["fig4"].collect(store, statistic=statistic))
        assert legend(figure)[0] == "ssail: 1 run, 1 diverged (x)"


def test_the_csv_is_what_is_drawn(store: Store, add_run: Any, tmp_path: Path) -> None:
    for seed, errors in enumerate([[0.04, 0.02, 0.01], [0.06, 0.03, 0.005]]):
        add_run(seed, errors)
        add_run(seed, [5 * error for error in errors], method="gail")
    add_run(2, [0.05, 0.7], RunState.DIVERGED)
    record = means(store)
    figure = fig4_stability.draw(record)
    csv = pd.read_csv(save("fig4", record, figure, tmp_path)[-1])
    assert set(csv["kind"]) == {"run", "mean", "diverged", "constant velocity"}
    compared, *panels = figure.axes
    assert [axes.get_title() for axes in panels] == ["ssail, every run", "gail, every run"]
    together = lines(compared)
    for axes, label in zip(panels, ("ssail", "gail"), strict=True):
        rows, named = csv[csv["label"] == label], lines(axes)
        for run_id, points in rows[rows["kind"] == "run"].groupby("run_id"):
            assert same(named.pop(f"run-{run_id}"), points)
        for run_id, points in rows[rows["kind"] == "diverged"].groupby("run_id"):
            np.testing.assert_array_equal(named.pop(f"diverged-{run_id}").get_xdata(), points["epoch"])
        assert named == {}
        centre = rows[rows["kind"] == "mean"]
        assert same(together.pop(f"centre-{label}"), centre)
        shown, band = centre.dropna(subset=["value"]), band_of(compared, label)
        assert list(band) == list(shown["epoch"]) == [1, 2, 3][: len(shown)]
        np.testing.assert_allclose([band[x][1] for x in shown["epoch"]], shown["high"])
    (reference,) = csv.loc[csv["kind"] == "constant velocity", "value"]
    assert list(together.pop("constant-velocity").get_ydata()) == [reference, reference]
    assert together == {}
    assert len(shown) == 3
    assert len(csv.query("kind == 'mean' and label == 'ssail'").dropna(subset=["value"])) == 2


def same(line: Line2D, rows: pd.DataFrame) -> bool:
    """Whether a line has exactly the points of these rows."""
    x, y = line.get_xdata(), line.get_ydata()
    return np.array_equal(x, rows["epoch"]) and np.array_equal(y, rows["value"], equal_nan=True)


def test_a_band_that_a_logarithm_cannot_show_is_cut_and_that_is_said(store: Store, add_run: Any) -> None:
    add_run(0, [0.1, 0.1])
    add_run(1, [0.2, 50.0])  # at epoch 2 the mean less the standard deviation is negative
    record = means(store)
    low = record.bands[0].summary.low
    assert low[1] < 0 < low[0]
    band = band_of(fig4_stability.draw(record).axes[0])
    np.testing.assert_allclose([band[1][0], band[2][0]], [low[0], 0.1 / 3])
    assert record.notes[-1].startswith("the band of ssail is cut a factor 3 below the lowest run")
    add_run(1, [0.2, 0.12])
    assert "is cut" not in " ".join(means(store).notes)


def test_the_scale_ends_where_every_rollout_has_diverged(store: Store, add_run: Any) -> None:
    add_run(0, [0.1, 0.1])
    add_run(1, [0.2, 1e9])
    record = FIGURES["fig4"].collect(store)
    assert fig4_stability.draw(record).axes[0].get_ylim()[1] == 100
    assert "ssail: 1 of the runs rise above 100, where the scale ends." in record.notes
    assert 1e9 in set(record.table()["value"])
    add_run(1, [0.2, 99.0])
    assert "where the scale ends" not in " ".join(FIGURES["fig4"].collect(store).notes)


def test_the_first_method_is_compared_with_the_others_by_an_exact_test(store: Store, add_run: Any) -> None:
    for seed in range(3):
        add_run(seed, [0.5, 0.01 + seed / 1000])
        add_run(seed, [0.5, 0.5 + seed], RunState.DIVERGED if seed == 2 else RunState.FINISHED, method="gail")
    (found,) = (note for note in FIGURES["fig4"].collect(store).notes if "permutation" in note)
    assert found.startswith("ssail against gail at the last epoch: medians 0.011 and 1.5, exact two-sided")
    assert found.endswith("p = 0.1 (least possible 0.1).")
    unfinished = add_run(3, [0.5], RunState.INTERRUPTED, method="gail")
    everything = FIGURES["fig4"].collect(store, [run.id for run in store.runs()])
    assert unfinished in everything.provenance.run_ids
    assert "permutation" not in " ".join(everything.notes)  # its last epoch is unknown


def test_many_runs_and_runs_that_all_diverged_do_no_harm(store: Store, add_run: Any) -> None:
    for seed in range(11):
        add_run(seed, [0.1])
        add_run(seed, [], RunState.DIVERGED, method="wail")
    for seed in range(3):
        add_run(seed, [], RunState.DIVERGED, method="gail")
    (found,) = (note for note in FIGURES["fig4"].collect(store).notes if "permutation" in note)
    assert found.startswith("ssail against gail at the last epoch: medians 0.1 and inf")
    assert len(drawn(store).axes) == 1 + 3


def test_one_panel_compares_the_methods_and_small_ones_have_the_runs(store: Store, add_run: Any) -> None:
    for method, level in (("ssail", 0.002), ("gail", 0.5), ("wail", 0.05)):
        for seed in range(2):
            add_run(seed, [1.0, level], method=method)
    figure = drawn(store)
    assert legend(figure) == ["ssail: 2 runs", "gail: 2 runs", "wail: 2 runs", "constant velocity (test)"]
    compared, *panels = figure.axes
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    assert len({(line.get_color(), line.get_linestyle()) for line in compared.lines}) == len(compared.lines) == 3 + 1
    assert [len(axes.lines) for axes in panels] == [2, 2, 2]


def test_no_label_is_cut(store: Store, add_run: Any) -> None:
    for method in ("ssail", "gail"):
        add_run(0, [1.0, 0.01], method=method)
        figure = drawn(store)  # of one method, and of two
        figure.canvas.draw()
        page = figure.bbox
        for axes in figure.axes:
            for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
                box = text.get_window_extent()
                assert page.x0 <= box.x0
                assert box.x1 <= page.x1 + 1
                assert page.y0 <= box.y0
                assert box.y1 <= page.y1


def test_the_axes_are_named_logarithmic_and_free_of_the_legend(store: Store, add_run: Any) -> None:
    add_run(0)
    figure = drawn(store)
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    assert axes.get_xlabel() == "epoch"
    assert axes.get_ylabel() == "squared error to the\nnearest lane (scaled units²)"
    figure.canvas.draw()
    assert not figure.legends[0].get_window_extent().overlaps(axes.get_window_extent())
    assert figure.get_size_inches()[0] == pytest.approx(3.4)


def test_ids_draw_unfinished_runs_and_keep_specs_apart(store: Store, add_run: Any) -> None:
    ids = [add_run(0), add_run(0, [0.3], RunState.RUNNING, overrides=["sac.gamma=0.5"])]
    record = FIGURES["fig4"].collect(store, ids)
    assert [len(band.curves) for band in record.bands] == [1, 1]
    figure = fig4_stability.draw(record)
    named = lines(figure.axes[0])
    colours = [named[f"centre-{band.label}"].get_color() for band in record.bands]
    assert colours[0] != colours[1]
    silent = add_run(1, [], RunState.RUNNING)
    with pytest.raises(InputError, match=rf"^run {silent[:8]} \(running\) has no train/mode_mse yet; "):
        FIGURES["fig4"].collect(store, [silent])
