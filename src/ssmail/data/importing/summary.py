"""What came in with an import, what was left out, and what may be a mistake."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ssmail.data.importing.cutting import Windows
from ssmail.data.importing.rows import Rows, quoted
from ssmail.data.importing.tracks import JUMP, Repairs, Tracks, speeds
from ssmail.data.recorded_sets import SetParameters
from ssmail.data.trajectories import SPLITS


@dataclass(frozen=True)
class Summary:
    """What came in. speeds: median, 99 % and maximum of the speeds, in units per step, or per second with dt.

    splits: split -> its scenes, windows, and the least and most agents of a window. same_agents: whether the agents are
    taken as the same ones in all scenes. left_out: what -> how many. remarks: sentences about what may be a mistake.
    """

    files: int
    rows: int
    scenes: int
    splits: Mapping[str, Mapping[str, int]]
    same_agents: bool
    speeds: Mapping[str, float]
    left_out: Mapping[str, int]
    remarks: Sequence[str]


def summarize(rows: Rows, tracks: Tracks, repairs: Repairs, parts: Sequence[Windows], params: SetParameters) -> Summary:
    """Summarize an import. parts: the windows of the three splits."""
    used = np.unique(np.concatenate([part.scene for part in parts]))
    return Summary(
        len(rows.files),
        len(rows),
        len(rows.scenes),
        {split: _counts(part) for split, part in zip(SPLITS, parts, strict=True)},
        params.identity,
        _speeds(tracks, params),
        _left_out(tracks, repairs, parts, len(rows.scenes) - len(used)),
        _remarks(tracks, rows, params),
    )


def _counts(part: Windows) -> dict[str, int]:
    return {
        "scenes": len(np.unique(part.scene)),
        "windows": len(part),
        "least_agents": int(part.agents.min()),
        "most_agents": int(part.agents.max()),
    }


def _speeds(tracks: Tracks, params: SetParameters) -> dict[str, float]:
    found, _ = speeds(tracks)
    median, high, top = (float(np.quantile(found, at)) / (params.dt or 1) for at in (0.5, 0.99, 1))
    return {"median": median, "99 %": high, "max": top}


def _left_out(tracks: Tracks, repairs: Repairs, parts: Sequence[Windows], scenes: int) -> dict[str, int]:
    """Return what was left out, and what was filled in, with how many there are. Rows are those that were read."""
    ends = np.zeros(len(tracks.positions) + 1, dtype=np.int64)
    for part in parts:
        np.add.at(ends, part.rows, 1)
        np.add.at(ends, part.rows + part.frames, -1)
    return {
        "gaps filled": repairs.gaps_filled,
        "frames filled in": repairs.frames_filled,
        "gaps at which tracks were cut": repairs.gaps_cut,
        "rows between the steps": repairs.off_step,
        "scenes without a window": scenes,
        "windows with too few agents": sum(part.few for part in parts),
        "agents of windows beyond --agents": sum(part.crowded for part in parts),
        "rows in no window": int((repairs.measured & (np.cumsum(ends[:-1]) == 0)).sum()),
    }


def _remarks(tracks: Tracks, rows: Rows, params: SetParameters) -> list[str]:
    remarks = []
    if params.split_by == "time":
        remarks.append(
            "fewer than three scenes have windows, so each was cut into three blocks of time, one for each split; they "
            "share no frame, but are more alike than different scenes"
        )
    if (steps := np.unique(tracks.step)).max() > 1:
        numbers = ", ".join(map(str, steps[:5]))
        remarks.append(f"frames are numbered in steps of {numbers}; windows count these steps")
    found, _ = speeds(tracks)
    moving = found[found > 0]
    jumps = int((found > JUMP * np.median(moving)).sum()) if len(moving) else 0
    if jumps:
        remarks.append(
            f"agents jump {jumps} times, faster than {JUMP} times the median speed: {fastest_step(tracks, rows)}; if "
            "these are errors, leave the rows out"
        )
    return remarks


def fastest_step(tracks: Tracks, rows: Rows) -> str:
    """Name the agent, scene and frame of the fastest step, and its distance."""
    found, begins = speeds(tracks)
    fastest = found.argmax()
    track = int(np.searchsorted(tracks.row, begins[fastest], side="right")) - 1
    scene = tracks.scene[track]
    step = tracks.begin[track] + begins[fastest] - tracks.row[track]
    return (
        f"agent {quoted(rows.agents[tracks.agent[track]])} of scene {quoted(rows.scenes[scene])} by "
        f"{found[fastest]:.4g} at frame {tracks.first[scene] + step * tracks.step[scene]}"
    )
