"""Windows of tracks: each holds the agents that are present from its first to its last frame."""

import heapq
from dataclasses import dataclass

import numpy as np

from ssmail.data.importing.tracks import Tracks
from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError

MOST_AGENTS = 2048  # in a window
LARGEST_SET = 2**31  # bytes of positions and velocities
_AT_ONCE = 2**22  # distances that are computed at once


@dataclass(frozen=True)
class Windows:
    """B windows of T + 1 frames and up to N agents, as places in the tracks; nothing is copied yet.

    scene, begin: (B,) the scene, and the step of the first frame. agents: (B,) how many there are. window, slot, track:
    (K,) of each agent of a window, in the order of windows and agents, the window, the place in it, and the track.
    few, crowded: windows that were left out as they have too few agents, and agents beyond the most of a window.
    """

    tracks: Tracks
    frames: int
    scene: Integers
    begin: Integers
    agents: Integers
    window: Integers
    slot: Integers
    track: Integers
    few: int = 0
    crowded: int = 0

    def __len__(self) -> int:
        return len(self.begin)

    @property
    def rows(self) -> Integers:
        """(K,) the index of the first position of each agent of a window."""
        return self.tracks.row[self.track] + self.begin[self.window] - self.tracks.begin[self.track]

    @property
    def names(self) -> Integers:
        """(K,) the number of each agent's name."""
        return self.tracks.agent[self.track].astype(np.int64)

    def positions(self, agents: int) -> Floats:
        """Return the positions (B, T + 1, agents, P); beyond the agents of a window they are zero."""
        axes = self.tracks.positions.shape[1]
        made = np.zeros((len(self), self.frames, agents, axes))
        made[self.window, :, self.slot] = _frames(self.tracks.positions, self.rows, self.frames)
        return made


def _frames(positions: Floats, rows: Integers, frames: int) -> Floats:
    """Return the positions (K, frames, P) from these rows on."""
    views = np.lib.stride_tricks.sliding_window_view(positions, frames, axis=0)  # (R - frames + 1, P, frames)
    found: Floats = views[rows].transpose(0, 2, 1)
    return found


def cut(tracks: Tracks, origin: Integers, frames: int, stride: int, least: int = 1) -> Windows:
    """Cut windows of so many frames that begin at origin, origin + stride, ... in each scene (scenes,).

    An agent is in a window if one of its tracks lasts throughout. Windows with less than `least` agents are left out.
    """
    from_origin = tracks.begin - origin[tracks.scene]
    first = -(-from_origin // stride)  # of the windows that each track has all frames of
    last = (from_origin + tracks.length - frames) // stride
    count = np.maximum(last - first + 1, 0)
    track = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(track)) - np.repeat(np.cumsum(count) - count, count) + first[track]

    # put the agents of each window together
    width = int(last.max(initial=0)) + 1
    key = tracks.scene[track].astype(np.int64) * width + place
    order = np.argsort(key, kind="stable")
    key, track = key[order], track[order]
    found, window, agents = np.unique(key, return_inverse=True, return_counts=True)
    kept = agents >= least
    stays = kept[window]
    scene, place = np.divmod(found[kept], width)
    return Windows(
        *(tracks, frames, scene, origin[scene] + place * stride, agents[kept]),
        *(np.repeat(np.arange(len(scene)), agents[kept]), _slots(agents[kept]), track[stays], int((~kept).sum())),
    )


def _slots(agents: Integers) -> Integers:
    """Count the agents of each window: [2, 3] -> [0, 1, 0, 1, 2]."""
    counted: Integers = np.arange(agents.sum()) - np.repeat(np.cumsum(agents) - agents, agents)
    return counted


def nearest(windows: Windows, most: int, frame: int) -> Windows:
    """Keep the `most` agents of each window that are nearest to one another in one of its frames.

    They are an agent and those nearest to it; it is the one for which their distances have the least sum.
    """
    crowded = np.flatnonzero(windows.agents > most)
    if not len(crowded):
        return windows
    if (largest := int(windows.agents.max())) > MOST_AGENTS:
        raise InputError(
            f"a window has {largest:,} agents, and {MOST_AGENTS:,} are the most to choose from; leave some out"
        )
    places = windows.tracks.positions[windows.rows + frame]
    starts = np.cumsum(windows.agents) - windows.agents
    keep = np.ones(len(windows.track), dtype=bool)
    by_number = crowded[np.argsort(windows.agents[crowded], kind="stable")]
    numbers, firsts = np.unique(windows.agents[by_number], return_index=True)
    for number, alike in zip(numbers.tolist(), np.split(by_number, firsts[1:]), strict=True):
        for part in np.array_split(alike, -(-len(alike) * number**2 // _AT_ONCE)):
            index = starts[part][:, None] + np.arange(number)  # (W, N)
            keep[index] = _nearest(places[index], most)
    agents = np.minimum(windows.agents, most)
    return Windows(
        *(windows.tracks, windows.frames, windows.scene, windows.begin, agents),
        *(windows.window[keep], _slots(agents), windows.track[keep], windows.few, int((~keep).sum())),
    )


def _nearest(places: Floats, most: int) -> Floats:
    """Return (W, N) which of the agents at (W, N, P) are the `most` that are nearest to one another."""
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    sums = np.partition(apart, most - 1, axis=-1)[..., :most].sum(axis=-1)
    middle = sums.argmin(axis=-1)
    chosen = np.argsort(apart[np.arange(len(apart)), middle], axis=-1, kind="stable")[:, :most]
    kept = np.zeros(apart.shape[:2], dtype=bool)
    np.put_along_axis(kept, chosen, True, axis=-1)
    return kept


def longest(tracks: Tracks, least: int = 1) -> Integers:
    """Return (scenes,) for how many frames at most `least` agents of each scene are present together."""
    found = np.zeros(len(tracks.first), dtype=np.int64)
    order = np.lexsort((tracks.begin, tracks.scene))
    scene, ends = -1, list[int]()  # ends: the `least` latest so far in the scene
    for index in order.tolist():
        if tracks.scene[index] != scene:
            scene, ends = int(tracks.scene[index]), []
        heapq.heappush(ends, int(tracks.begin[index] + tracks.length[index]))
        if len(ends) > least:
            heapq.heappop(ends)
        if len(ends) == least:
            found[scene] = max(found[scene], ends[0] - tracks.begin[index])
    return found


def check_size(windows: list[Windows], agents: int) -> None:
    """Raise InputError if the arrays of the windows would be too large for a file, or if they have too many agents."""
    if agents > MOST_AGENTS:
        raise InputError(f"a window has {agents:,} agents, and {MOST_AGENTS:,} are the most; limit them with --agents")
    size = sum(len(some) * some.frames for some in windows) * agents * windows[0].tracks.positions.shape[1] * 16
    if size > LARGEST_SET:
        raise InputError(
            f"windows of up to {agents} agents need {size / 2**30:.1f} GiB, and 2 are the most; raise --stride, or "
            "limit --agents"
        )
