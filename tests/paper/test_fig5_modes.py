"""Figure 5: which rollouts a panel shows, that it counts these, and that picture and CSV agree."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssmail.errors import InputError
from ssmail.evaluation.metrics import ON_PATH_TOLERANCE, polyline_distances
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


def titles(figure: Figure) -> list[str]:
    return [axes.get_title() for axes in panels(figure)]


def test_a_panel_holds_the_samples_in_turn_and_counts_them(store: Store, add_run: Any) -> None:
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
        assert panel.on_path == 1.0
        assert panel.lanes.tolist() == [0, 0, 0]  # lane (s + b) % 2
        assert record.outside(panel) == 0
    np.testing.assert_array_equal(record.centre_lines, arrays()["lane_centres"])
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
    strays = arrays()["test/rollouts"]
    strays[0, 0, 3, 1, 1] += 1.5  # the other agent and the other rollouts stay on the path
    runs = [add_run(0), add_run(1, test__rollouts=strays)]
    record = FIGURES["fig5"].collect(store)
    figure = fig5_modes.draw(record)
    csv = pd.read_csv(save("modes", record, figure, tmp_path)[-1])
    for axes, run in zip(panels(figure), runs, strict=True):
        rows = csv[(csv["run_id"] == run) & (csv["kind"] == "rollout")]
        for stays, colour in ((1, fig5_modes.STAYS), (0, fig5_modes.LEAVES)):
            tracks = rows[rows["on_path"] == stays]
            assert same(paths(axes, colour), tracks, ["trajectory", "agent"])
            dots = [line for line in axes.lines if line.get_marker() == "." and line.get_color() == colour]
            last = tracks[tracks["step"] == tracks["step"].max()]
            assert len(dots) == (len(last) > 0)
            for line in dots:
                np.testing.assert_array_equal(line.get_xydata(), last[["x", "y"]].to_numpy(np.float32))
        assert axes.get_aspect() == 1.0
    strayed = csv[(csv["run_id"] == runs[1]) & (csv["on_path"] == 0)]
    assert set(zip(strayed["trajectory"], strayed["agent"], strict=True)) == {(0, 1)}
    assert words(panels(figure)[1]) == ["83 % on path", "lanes 3 : 0"]
    assert figure.get_supxlabel() == "x (step lengths)"
    assert figure.get_supylabel() == "y (step lengths)"


def test_the_strip_is_as_wide_as_what_counts_as_on_the_path(store: Store, add_run: Any) -> None:
    add_run(0)
    (axes,) = panels(fig5_modes.draw(FIGURES["fig5"].collect(store)))
    strips = [patch.get_xy() for patch in axes.patches if patch.get_fill() and len(patch.get_xy()) > 5]
    assert len(strips) == 2
    for outline, line in zip(strips, arrays()["lane_centres"], strict=True):
        away = polyline_distances(outline[1:5], line, extended=True)  # of points far from the bend
        np.testing.assert_allclose(away[:2], ON_PATH_TOLERANCE, atol=1e-6)
        assert outline[:, 0].max() > line[:, 0].max()  # it goes on to the edge


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
    assert words(second) == ["diverged:", "no test rollouts"]
    assert "diverged:" not in words(first)
    assert paths(second, fig5_modes.STAYS) == paths(second, fig5_modes.LEAVES) == []
    assert len(paths(first, fig5_modes.STAYS)) == STARTS * AGENTS
    assert list(record.table().query("kind == 'diverged'")["run_id"]) == [lost]


def test_only_diverged_seeds_can_be_drawn(store: Store, add_run: Any) -> None:
    for seed in range(3):
        add_run(seed, [0.5], RunState.DIVERGED)
    record = FIGURES["fig5"].collect(store)
    assert titles(fig5_modes.draw(record)) == ["ssail, seed 0", "ssail, seed 1", "ssail, seed 2"]
    assert list(record.table()["kind"]) == ["diverged"] * 3


def test_each_label_begins_a_row(store: Store, add_run: Any) -> None:
    ids = [add_run(0), add_run(1), add_run(0, overrides=["sac.gamma=0.5"])]
    figure = fig5_modes.draw(FIGURES["fig5"].collect(store, ids))
    labels = [f"ssail {spec}" for spec in dict.fromkeys(run.spec_hash[:8] for run in store.runs())]
    assert titles(figure) == [f"{labels[0]}, seed 0", f"{labels[0]}, seed 1", f"{labels[1]}, seed 0"]
    places = [axes.get_subplotspec() for axes in panels(figure)]
    assert [(place.rowspan.start, place.colspan.start) for place in places] == [(0, 0), (0, 1), (1, 0)]


def test_two_methods_of_five_seeds_are_two_rows_of_five_on_a_page(store: Store, add_run: Any) -> None:
    for seed in range(5):
        for method in ("dnri", "ssail"):
            add_run(seed, method=method)
    figure = fig5_modes.draw(FIGURES["fig5"].collect(store))
    assert titles(figure) == [f"{method}, seed {seed}" for method in ("ssail", "dnri") for seed in range(5)]
    assert figure.get_size_inches()[0] == style.PAGE_WIDTH
    figure.canvas.draw()
    (legend,) = figure.legends
    assert not any(legend.get_window_extent().overlaps(axes.get_window_extent()) for axes in panels(figure))


def test_an_unfinished_run_is_refused(store: Store, add_run: Any) -> None:
    run = add_run(0, state=RunState.INTERRUPTED)
    with pytest.raises(InputError, match=rf"^run {run[:8]} \(interrupted\) has no test rollouts; "):
        FIGURES["fig5"].collect(store, [run])


def test_notes_have_the_metrics_of_all_rollouts(store: Store, add_run: Any) -> None:
    """Stored, or computed for runs of earlier versions: rollout k = 3 s + b is 0.01 k aside of the street."""
    add_run(0, measured=False)
    add_run(1, measured=False, shift=1.5)
    add_run(2)
    record = FIGURES["fig5"].collect(store)
    assert [panel.on_path for panel in record.panels] == [1, 0, 1]
    assert record.notes[-3:-1] == (
        "ssail: over all test rollouts test/on_path is 100 % (seed 0), 0 % (seed 1), 75 % (seed 2).",
        "ssail: over all test rollouts test/lane_balance is 25 % (seed 0), 25 % (seed 1), 25 % (seed 2).",
    )
    assert record.notes[-1].startswith("test/on_path of 2 runs, stored before")
    assert record.notes[-1].endswith("the 6 test rollouts stored of each.")


def test_a_panel_has_a_dash_where_the_lanes_are_unknown(store: Store, add_run: Any) -> None:
    add_run(0, lane_centres=np.zeros(0))
    (axes,) = panels(fig5_modes.draw(FIGURES["fig5"].collect(store)))
    assert words(axes) == ["- on path", "lanes 3"]
