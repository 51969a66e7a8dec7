"""Tracks, windows and splits against brute force and by hand."""

from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.data.importing.cutting import cut, longest, nearest
from ssmail.data.importing.rows import Rows, SourceFile
from ssmail.data.importing.splitting import split_scenes, split_times
from ssmail.data.importing.tracks import Tracks, make_tracks, speeds

FILE = (SourceFile(Path("a.csv"), "a"), 10**6, "row {}".format)


def rows_of(*rows: tuple[int, float, int, float]) -> Rows:
    """Rows from (scene, frame, agent, x)."""
    scene, frame, agent, x = np.array(rows, dtype=float).reshape(-1, 4).T
    names = [tuple(map(str, range(int(column.max()) + 1))) for column in (scene, agent)]
    return Rows(scene.astype(np.int32), frame, agent.astype(np.int32), x[:, None], *names, (FILE,))


def tracks_of(*rows: tuple[int, float, int, float], fill: int = 0) -> Tracks:
    return make_tracks(rows_of(*rows), None, fill)[0]


def run(agent: int, begin: int, end: int, scene: int = 0) -> list[tuple[int, float, int, float]]:
    """An agent at x = 100 agent + frame in the frames [begin, end)."""
    return [(scene, frame, agent, 100.0 * agent + frame) for frame in range(begin, end)]


def test_rows_are_sorted_and_frames_counted_in_steps() -> None:
    made, repairs = make_tracks(rows_of((0, 30, 1, 3), (0, 10, 1, 1), (0, 20, 1, 2), (0, 40, 1, 4)), None, 0)
    assert (made.first.tolist(), made.step.tolist()) == ([10], [10])
    assert (made.begin.tolist(), made.length.tolist()) == ([0], [4])
    assert made.positions.ravel().tolist() == [1, 2, 3, 4]
    assert (repairs.gaps_cut, repairs.off_step) == (0, 0)


def test_each_scene_has_its_own_step_and_rows_between_are_left_out() -> None:
    ten = [(0, 10 * count, 0, count) for count in range(5)]
    one = [(1, 7 + count, 0, count) for count in range(5)]
    made, repairs = make_tracks(rows_of(*ten, (0, 13, 1, 0), *one), None, 0)
    assert (made.step.tolist(), made.first.tolist()) == ([10, 1], [0, 7])
    assert (made.length.tolist(), repairs.off_step) == ([5, 5], 1)


def test_gaps_are_filled_up_to_a_length_and_cut_beyond() -> None:
    rows = [(0, frame, 0, float(frame**2)) for frame in (0, 1, 2, 4, 5, 9, 10)]
    made, repairs = make_tracks(rows_of(*rows), None, 1)
    assert (repairs.gaps_filled, repairs.frames_filled, repairs.gaps_cut) == (1, 1, 1)
    assert made.positions.ravel().tolist() == [0, 1, 4, 10, 16, 25, 81, 100]  # (4 + 16) / 2 = 10
    assert (made.begin.tolist(), made.length.tolist(), made.row.tolist()) == ([0, 9], [6, 2], [0, 6])
    made, repairs = make_tracks(rows_of(*rows), None, 0)
    assert (repairs.gaps_filled, repairs.gaps_cut, made.length.tolist()) == (0, 2, [3, 2, 2])
    made, repairs = make_tracks(rows_of(*rows), None, 3)
    assert (repairs.frames_filled, made.length.tolist()) == (4, [11])
    assert made.positions.ravel().tolist()[5:10] == [25, 39, 53, 67, 81]


def test_speeds_are_within_tracks() -> None:
    found, begins = speeds(tracks_of((0, 0, 0, 0), (0, 1, 0, 3), (0, 0, 1, 50), (0, 1, 1, 51), (0, 5, 1, 90)))
    assert (found.tolist(), begins.tolist()) == ([3, 1], [0, 2])


def brute_force(rows: list[tuple[int, float, int, float]], frames: int, stride: int, least: int) -> dict:
    """(scene, begin) -> the agents, for scenes whose frames are numbered by one."""
    table = pd.DataFrame(rows, columns=["scene", "frame", "agent", "x"])
    found = {}
    for scene, inside in table.groupby("scene"):
        there = {(frame, agent) for frame, agent in zip(inside.frame, inside.agent, strict=True)}
        first = int(inside.frame.min())
        for begin in range(0, int(inside.frame.max()) - first + 2 - frames, stride):
            agents = [
                agent
                for agent in sorted(set(inside.agent))
                if all((first + begin + step, agent) in there for step in range(frames))
            ]
            if len(agents) >= max(least, 1):
                found[scene, begin] = agents
    return found


@settings(deadline=None)
@given(st.data())
def test_windows_are_those_of_brute_force(data: st.DataObject) -> None:
    rows = []
    for scene in range(data.draw(st.integers(1, 2))):
        rows += run(9, 0, 14, scene)  # so that the step of the scene is 1, and its first frame 0
        for agent in range(data.draw(st.integers(1, 3))):
            absent = data.draw(st.sets(st.integers(0, 13), max_size=6))
            rows += [row for row in run(agent, 0, 14, scene) if row[1] not in absent]
    frames, stride, least = (data.draw(st.integers(*ends)) for ends in ((2, 6), (1, 5), (1, 3)))
    made = cut(tracks_of(*rows), np.zeros(2, dtype=np.int64), frames, stride, least)
    wanted = brute_force(rows, frames, stride, least)
    assert list(zip(made.scene.tolist(), made.begin.tolist(), strict=True)) == list(wanted)
    names = [part.tolist() for part in np.split(made.names, np.cumsum(made.agents)[:-1])] if wanted else []
    assert names == list(wanted.values())
    positions = made.positions(int(made.agents.max(initial=1)))
    for window, ((_, begin), agents) in enumerate(wanted.items()):
        expected = np.add.outer(np.arange(begin, begin + frames), 100 * np.array(agents))
        np.testing.assert_array_equal(positions[window, :, : len(agents), 0], expected)
        assert not positions[window, :, len(agents) :].any()


def test_the_longest_window() -> None:
    tracks = tracks_of(*run(0, 0, 10), *run(1, 4, 12), *run(2, 6, 9), *run(0, 0, 3, scene=1))
    assert longest(tracks).tolist() == [10, 3]
    assert longest(tracks, 2).tolist() == [6, 0]  # agents 0 and 1 in the frames 4 to 9
    assert longest(tracks, 3).tolist() == [3, 0]
    frames = int(longest(tracks, 2)[0])
    start = np.zeros(2, dtype=np.int64)
    assert len(cut(tracks, start, frames, 1, 2)) == 1
    assert len(cut(tracks, start, frames + 1, 1, 2)) == 0


def test_the_nearest_agents_stay() -> None:
    """Of the places 0, 10, 11, 13 and 30, the three from 10 to 13 are the nearest to one another."""
    rows = [(0, frame, agent, place) for agent, place in enumerate((30, 13, 0, 11, 10)) for frame in range(3)]
    made = cut(tracks_of(*rows), np.zeros(1, dtype=np.int64), 3, 1)
    kept = nearest(made, 3, 1)
    assert kept.positions(3)[0, 0, :, 0].tolist() == [13, 11, 10]
    assert (kept.agents.tolist(), kept.slot.tolist(), kept.crowded) == ([3], [0, 1, 2], 2)
    assert nearest(made, 5, 1) is made


def test_a_later_frame_does_not_decide_which_agents_stay() -> None:
    """Two agents that are near at first and far afterwards stay, if the frame to look at is the first."""
    rows = [(0, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1), (0, 1, 1, 99), (0, 0, 2, 50), (0, 1, 2, 0)]
    made = cut(tracks_of(*rows), np.zeros(1, dtype=np.int64), 2, 1)
    assert [nearest(made, 2, frame).names.tolist() for frame in (0, 1)] == [[0, 1], [0, 2]]


@given(st.lists(st.integers(0, 30), min_size=3, max_size=40).filter(lambda found: sum(map(bool, found)) >= 3))
def test_scenes_are_dealt_out_whole_and_every_split_gets_one(found: list[int]) -> None:
    names, windows = [f"scene {number}" for number in range(len(found))], np.array(found)
    split = split_scenes(names, windows, (70, 15, 15))
    assert ((split == -1) == (windows == 0)).all()
    assert set(split[windows > 0]) == {0, 1, 2}
    order = np.random.default_rng(0).permutation(len(found))
    again = split_scenes([names[number] for number in order], windows[order], (70, 15, 15))
    assert again.tolist() == split[order].tolist(), "whatever the order of the scenes"


def test_splits_are_as_large_as_their_shares() -> None:
    split = split_scenes([str(number) for number in range(100)], np.full(100, 7), (70, 20, 10))
    assert np.bincount(split).tolist() == [70, 20, 10]


def test_blocks_of_time_share_no_frame() -> None:
    blocks = split_times(tracks_of(*run(0, 0, 100), *run(1, 60, 100)), 1, (70, 15, 15))
    assert [start.tolist() for _, start in blocks] == [[0], [70], [85]]
    assert [part.length.tolist() for part, _ in blocks] == [[70, 10], [15, 15], [15, 15]]
    firsts = [part.positions[part.row].ravel().tolist() for part, _ in blocks]
    assert firsts == [[0, 160], [70, 170], [85, 185]]
