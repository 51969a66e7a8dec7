"""Figure 3: measured and expected segment lengths, in the record, the picture and the CSV."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.lines import Line2D

from ssmail.config.experiments import ablation, ablation_specs
from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.paper import fig3_curricula
from ssmail.paper.results import FIGURES
from ssmail.plots import style
from ssmail.store import RunState, Store
from tests.paper.figure_files import save


@pytest.fixture
def filled(store: Store, ablate: Any) -> Store:
    ablate("curriculum", {name: [0.1, 0.2] for name in ablation("curriculum").values})
    return store


def test_every_curriculum_is_measured_and_expected(filled: Store) -> None:
    record = FIGURES["fig3"].collect(filled)
    assert [band.label for band in record.bands] == list(ablation("curriculum").values)
    for band, closed in zip(record.bands, record.expected, strict=True):
        assert [curve.seed for curve in band.curves] == [0, 1]
        np.testing.assert_allclose(band.summary, [[1.1, 2.2, 3.3]] * 3)
        np.testing.assert_array_equal(closed.epochs, [1, 2, 3])
        np.testing.assert_array_equal(closed.values, [1, 2, 3])
    assert len(record.provenance.run_ids) == 6


def test_the_closed_form_is_that_of_the_run_with_most_epochs(store: Store, ablate: Any) -> None:
    ablate("curriculum", {"teacher-forcing": [None, 0.1]})  # the first seed diverged after one epoch
    (closed,) = FIGURES["fig3"].collect(store).expected
    np.testing.assert_array_equal(closed.values, [1, 2, 3])
    assert closed.seed == 1
    (band,) = FIGURES["fig3"].collect(store).bands
    assert band.diverged == 1
    np.testing.assert_allclose(band.summary.centre, [1.1, np.nan, np.nan])


def test_picture_and_csv_show_the_record(filled: Store, tmp_path: Path) -> None:
    record = FIGURES["fig3"].collect(filled, statistic=Statistic.MEDIAN_IQR)
    figure = fig3_curricula.draw(record)
    csv = pd.read_csv(save("curricula", record, figure, tmp_path)[-1])
    (axes,) = figure.axes
    drawn = {str(line.get_gid()): line for line in axes.lines if line.get_gid()}
    for label, rows in csv.groupby("label"):
        for run_id, points in rows[rows["kind"] == "run"].groupby("run_id"):
            assert same(drawn.pop(f"run-{run_id}"), points)
        assert same(drawn.pop(f"centre-{label}"), rows[rows["kind"] == "median"])
        closed = drawn.pop(f"closed-form-{label}")
        assert same(closed, rows[rows["kind"] == "closed form"])
        assert closed.get_color() == style.REFERENCE
        assert closed.is_dashed()
    assert drawn == {}
    assert axes.get_ylabel() == "mean segment length\n(steps, logarithmic scale)"
    assert axes.get_xlabel() == "epoch"
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[-1] == "expected, T / (1 + (T - 1) f)"
    assert words[:-1] == [f"{name}: 2 runs" for name in ablation("curriculum").values]
    figure.canvas.draw()
    assert not figure.legends[0].get_window_extent().overlaps(axes.get_window_extent())
    plain = [label.get_text() for label in axes.get_yticklabels()]
    assert {"1", "2"} <= set(plain)


def same(line: Line2D, rows: pd.DataFrame) -> bool:
    """Whether a line has exactly the points of these rows."""
    return np.array_equal(line.get_xdata(), rows["epoch"]) and np.array_equal(line.get_ydata(), rows["value"])


def test_a_run_without_segment_lengths_is_refused(store: Store, add_run: Any) -> None:
    spec = ablation_specs("curriculum", "smoke")["teacher-forcing"]
    run = add_run(0, state=RunState.INTERRUPTED, spec=spec)
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no curriculum/segment_length yet; "):
        FIGURES["fig3"].collect(store, [run])
