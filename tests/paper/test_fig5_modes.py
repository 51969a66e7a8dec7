"""Figure 5: which rollouts a panel shows, what it says of them, and that picture and CSV agree."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssmail.errors import InputError
from ssmail.paper import fig5_modes
from ssmail.paper.results import FIGURES
from ssmail.plots import style
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

from .handmade_arrays import AGENTS, STARTS, arrays, lanes


def words(axes: Axes) -> list[str]:
    return [line for text in axes.texts for line in text.get_text().split("\n")]


def panels(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.axison]


def paths(axes: Axes, colour: str) -> list[np.ndarray]:
    """(T, 2) of every line of that colour, dots left out."""
    return [line.get_xydata() for line in axes.lines if line.get_color() == colour and line.get_marker() == "None"]


def test_a_panel_holds_the_samples_in_turn_and_the_stored_shares(store: Store, add_run: Any) -> None:
    runs = [add_run(0), add_run(1, shift=0.1)]
    record = FIGURES["fig5"].collect(store)
    assert [(panel.label, panel.run_id, panel.seed) for panel in record.panels] == [
        ("ssail", runs[0], 0),
        ("ssail", runs[1], 1),
    ]
    for panel, shift in zip(record.panels, (0.0, 0.1), strict=True):
        stored = arrays(shift)["test/rollouts"]
        expected = [stored[0, 0], stored[1, 1], stored[0, 2]]  # start b with sample b % 2
        np.testing.assert_array_equal(panel.rollouts, expected)
        assert (panel.on_path, panel.path_rms, panel.lane_balance) == (0.75, 0.5, 0.25)
        assert record.outside(panel) == 0
    np.testing.assert_array_equal(record.expert, lanes())
    assert record.provenance.run_ids == tuple(runs)


def test_the_shown_starts_are_spread_over_all(store: Store, add_run: Any) -> None:
    many = np.repeat(np.repeat(np.arange(100.0), 4).reshape(1, 100, 2, 1, 2), 2, axis=0)  # position = start
    add_run(0, test__rollouts=many, test__lanes=many)
    (panel,) = FIGURES["fig5"].collect(store).panels
    starts = panel.rollouts[:, 0, 0, 0]
    assert len(starts) == fig5_modes.STARTS
    assert (starts[0], starts[-1]) == (0, 99)
    assert set(np.diff(starts)) <= {6, 7}


def test_picture_and_csv_show_the_record(store: Store, add_run: Any, tmp_path: Path) -> None:
    runs = [add_run(0), add_run(1, shift=0.1)]
    record = FIGURES["fig5"].collect(store)
    figure = fig5_modes.draw(record)
    csv = pd.read_csv(save("modes", record, figure, tmp_path)[-1])
    colour = style.METHODS["ssail"].colour
    for axes, run in zip(panels(figure), runs, strict=True):
        rows = csv[(csv["run_id"] == run) & (csv["kind"] == "rollout")]
        assert same(paths(axes, colour), rows, ["trajectory", "agent"])
        assert same(paths(axes, style.LANE), csv[csv["kind"] == "expert"], ["lane", "trajectory", "agent"])
        (dots,) = (line for line in axes.lines if line.get_marker() == ".")
        last = rows[rows["step"] == rows["step"].max()]
        np.testing.assert_array_equal(dots.get_xydata(), last[["x", "y"]].to_numpy(np.float32))
        assert (set(rows["on_path"]), set(rows["path_rms"])) == ({0.75}, {0.5})
        assert axes.get_aspect() == 1.0
    assert words(panels(figure)[1]) == ["seed 1", "75 % on path", "rms 0.5", "rarer lane 25 %"]
    assert figure.get_supxlabel() == "x (step lengths)"
    assert figure.get_supylabel() == "y (step lengths)"


def same(drawn: list[np.ndarray], rows: pd.DataFrame, keys: list[str]) -> bool:
    """Whether the drawn lines are those of the rows, grouped by `keys`, to the last digit of the stored float32."""
    tracks = [track[["x", "y"]].to_numpy(np.float32) for _, track in rows.groupby(keys)]
    return len(drawn) == len(tracks) and all(np.array_equal(a, b) for a, b in zip(drawn, tracks, strict=True))


def test_the_frame_widens_for_rollouts_but_only_so_far(store: Store, add_run: Any) -> None:
    add_run(0)
    tight = FIGURES["fig5"].collect(store).frame
    side = np.ptp(lanes().reshape(-1, 2), axis=0).max()
    wide = arrays()["test/rollouts"]
    wide[0, 0, 4, 0, 1] = lanes()[..., 1].max() + 0.15 * side
    add_run(0, test__rollouts=wide)
    record = FIGURES["fig5"].collect(store)
    assert record.outside(record.panels[0]) == 0
    assert record.frame[3] == pytest.approx(lanes()[..., 1].max() + 0.2 * side)
    assert record.frame[:3] == tight[:3]


def test_what_leaves_the_frame_is_counted(store: Store, add_run: Any) -> None:
    wild = arrays()["test/rollouts"]
    wild[0, 0, 3:, 0, 1] = 50.0
    wild[1, 1, 4, 1] = np.nan
    wild[0, 2, 4, 0, 0] = -np.inf
    add_run(0, test__rollouts=wild)
    record = FIGURES["fig5"].collect(store)
    assert record.outside(record.panels[0]) == 3
    (axes,) = panels(fig5_modes.draw(record))
    assert words(axes)[-1] == "3 of 3 cut off"
    assert axes.get_ylim()[1] < 50


def test_a_diverged_seed_has_a_panel_that_says_so(store: Store, add_run: Any) -> None:
    add_run(0)
    lost = add_run(1, [0.5, np.inf], RunState.DIVERGED)
    record = FIGURES["fig5"].collect(store)
    assert [panel.rollouts is None for panel in record.panels] == [False, True]
    first, second = panels(fig5_modes.draw(record))
    assert words(second) == ["seed 1", "diverged:", "no test rollouts"]
    assert "diverged:" not in words(first)
    assert len(paths(second, style.LANE)) == 2 * STARTS * AGENTS
    assert paths(second, style.METHODS["ssail"].colour) == []
    assert list(record.table().query("kind == 'diverged'")["run_id"]) == [lost]


def test_only_diverged_seeds_can_be_drawn(store: Store, add_run: Any) -> None:
    for seed in range(3):
        add_run(seed, [0.5], RunState.DIVERGED)
    record = FIGURES["fig5"].collect(store)
    assert [words(axes)[0] for axes in panels(fig5_modes.draw(record))] == ["seed 0", "seed 1", "seed 2"]
    assert list(record.table()["kind"]) == ["diverged"] * 3


def test_two_groups_stand_in_two_columns(store: Store, add_run: Any) -> None:
    ids = [add_run(0), add_run(1), add_run(0, overrides=["sac.gamma=0.5"])]
    figure = fig5_modes.draw(FIGURES["fig5"].collect(store, ids))
    labels = [f"ssail {spec}" for spec in dict.fromkeys(run.spec_hash[:8] for run in store.runs())]
    places = {(words(axes)[0], axes.get_subplotspec().colspan.start) for axes in panels(figure)}
    assert places == {("seed 0", 0), ("seed 1", 0), ("seed 0", 1)}
    assert [axes.get_title() for axes in panels(figure)] == [labels[0], labels[1], ""]


def test_methods_stand_side_by_side_in_the_order_of_experiments_yaml(store: Store, add_run: Any) -> None:
    for seed in range(2):
        for method in ("dnri", "ssail"):
            add_run(seed, method=method, shift=seed)
    figure = fig5_modes.draw(FIGURES["fig5"].collect(store))
    assert [axes.get_title() for axes in panels(figure)] == ["ssail", "dnri", "", ""]
    for axes, method in zip(panels(figure), ("ssail", "dnri") * 2, strict=True):
        assert len(paths(axes, style.METHODS[method].colour)) == STARTS * AGENTS
    figure.canvas.draw()
    (legend,) = figure.legends
    assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in panels(figure))


def test_an_unfinished_run_is_refused(store: Store, add_run: Any) -> None:
    run = add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no test rollouts; "):
        FIGURES["fig5"].collect(store, [run])


def test_an_earlier_run_has_the_numbers_of_its_stored_rollouts(store: Store, add_run: Any) -> None:
    """Rollout k = 3 s + b is 0.01 k aside of the street, and on a lane of 45 degrees 0.01 k / sqrt(2)."""
    add_run(0, measured=False)
    add_run(1, measured=False, shift=1.5)
    add_run(2)
    record = FIGURES["fig5"].collect(store)
    near, far, new = record.panels
    assert (near.on_path, far.on_path, new.on_path) == (1, 0, 0.75)
    assert 0.01 < near.path_rms < 0.05
    assert 1.06 < far.path_rms < 1.55
    assert record.notes[-1].startswith("test/on_path, test/path_rms of 2 runs, stored before")
    assert "the 6 test rollouts stored of each" in record.notes[-1]


def test_a_panel_has_a_dash_for_what_nobody_knows(store: Store, add_run: Any) -> None:
    add_run(0, measured=False, lane_centres=np.zeros(0))
    (axes,) = panels(fig5_modes.draw(FIGURES["fig5"].collect(store)))
    assert words(axes) == ["seed 0", "- on path", "rms -", "rarer lane 25 %"]
