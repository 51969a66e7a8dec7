"""Figure 9: the environment as a run stored it, drawn to scale."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ssmail.errors import InputError
from ssmail.paper import fig9_yjunction
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

from .handmade_arrays import AGENTS, STEPS, lanes


def test_the_first_trajectory_of_each_lane_is_shown(store: Store, add_run: Any) -> None:
    run = add_run(0)
    record = FIGURES["fig9"].collect(store)
    np.testing.assert_array_equal(record.lanes, [0, 1])
    np.testing.assert_array_equal(record.trajectories, [lanes()[0, 1], lanes()[1, 0]])  # train/lane is 1, 0, 1
    np.testing.assert_array_equal(record.steps, [0, 1, 3, 4])
    assert record.fork == (2.0, 0.0)
    # start 2 runs 0.2 behind the points of the centre line: 0.2 on the street, 0.2 sqrt(2) on the lane
    assert record.half_width == pytest.approx(2 * 0.2 * np.sqrt(2), rel=1e-5)
    assert record.provenance.run_ids == (run,)


def test_picture_and_csv_show_the_record(store: Store, add_run: Any, tmp_path: Path) -> None:
    add_run(0)
    record = FIGURES["fig9"].collect(store)
    figure = fig9_yjunction.draw(record)
    (axes,) = figure.axes
    csv = pd.read_csv(save("fig9", record, figure, tmp_path)[-1])
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (step lengths)", "y (step lengths)")
    drawn = [line.get_xydata() for line in axes.lines]
    for kind, keys in (("centre line", ["lane"]), ("trajectory", ["lane", "agent"]), ("agent", ["lane", "agent"])):
        for _, rows in csv[csv["kind"] == kind].groupby(keys):
            assert sum(np.array_equal(rows[["x", "y"]].to_numpy(np.float32), line) for line in drawn) == 1
    assert len(drawn) == 2 + 2 * 2 * AGENTS + 1  # centre lines, tracks and agents, the fork
    texts = {text.get_text() for text in axes.texts}
    assert texts == {"street", "fork", "lane 0", "lane 1", "t = 0", "t = 1", "t = 3", f"t = {STEPS - 1}"}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["agent 0", "agent 1"]


def test_a_training_set_that_uses_one_lane_still_shows_both(store: Store, add_run: Any) -> None:
    add_run(0, train__lane=np.array([1, 1, 1]))
    record = FIGURES["fig9"].collect(store)
    np.testing.assert_array_equal(record.lanes, [1])
    assert {"lane 0", "lane 1"} <= {text.get_text() for text in fig9_yjunction.draw(record).axes[0].texts}


def test_the_newest_run_with_the_expert_set_is_the_source(store: Store, add_run: Any) -> None:
    first, second = add_run(0), add_run(1)
    without = add_run(2, state=RunState.DIVERGED)
    assert FIGURES["fig9"].collect(store).provenance.run_ids == (second,)
    assert FIGURES["fig9"].collect(store, [first, without]).provenance.run_ids == (first,)


def test_a_run_without_the_expert_set_stands_for_one_on_the_same_data(store: Store, add_run: Any) -> None:
    """As in a compact database, which holds the set once."""
    holds = add_run(0)
    add_run(1, dataset_hash="e" * 64)
    same, other = (add_run(2 + n, state=RunState.DIVERGED, dataset_hash=data * 64) for n, data in enumerate("df"))
    assert FIGURES["fig9"].collect(store, [same]).provenance.run_ids == (holds,)
    with pytest.raises(InputError, match=r"^none of the given runs holds the expert set of yjunction; "):
        FIGURES["fig9"].collect(store, [other])


def test_no_runs_is_one_sentence_with_the_command(store: Store, add_run: Any) -> None:
    command = "run `ssmail train --method ssail --env yjunction --profile quick --seeds 0-4`."
    with pytest.raises(NoRuns) as empty:
        FIGURES["fig9"].collect(store)
    assert str(empty.value) == f"fig9 has nothing to draw: {store.where} holds no run on yjunction; {command}"
    add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(NoRuns, match="holds no finished run on yjunction"):
        FIGURES["fig9"].collect(store)
