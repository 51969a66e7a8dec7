"""The three splits: each scene belongs to one of them; fewer than three scenes are cut into blocks of time."""

import fnmatch
import hashlib
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ssmail.data.importing.rows import plain_name, quoted
from ssmail.data.importing.tracks import Tracks
from ssmail.data.trajectories import SPLITS, Integers
from ssmail.errors import InputError, unknown_name

Shares = tuple[int, int, int]


def split_scenes(names: Sequence[str], windows: Integers, shares: Shares) -> Integers:
    """Return the split (scenes,) of each scene, an index into SPLITS; -1 for a scene without windows.

    Scenes are dealt out from the one with the most windows to the one with the fewest, in an order that the digests of
    their names decide if they have equally many, each to the split that lacks the most windows of its share. So the
    same scenes are always split alike, and every split gets one. windows: (scenes,) how many each has; three at least
    must have some.
    """
    split = np.full(len(names), -1)
    order = sorted(
        np.flatnonzero(windows).tolist(),
        key=lambda scene: (-windows[scene], hashlib.sha256(names[scene].encode()).digest()),
    )
    lacks = np.array(shares) / sum(shares) * windows.sum()
    empty = set(range(len(SPLITS)))
    for left, scene in zip(range(len(order), 0, -1), order, strict=True):
        choices = sorted(empty) if left == len(empty) else range(len(SPLITS))
        chosen = max(choices, key=lambda one: lacks[one])
        split[scene] = chosen
        lacks[chosen] -= windows[scene]
        empty.discard(chosen)
    return split


def named_scenes(names: Sequence[str], validation: Sequence[str], test: Sequence[str]) -> Integers:
    """Return the split (scenes,) of each scene: 1 or 2 if its name matches one of the patterns, 0 otherwise.

    Raises InputError for a pattern that no name matches, and for a scene in two splits.
    """
    split = np.zeros(len(names), dtype=np.int64)
    for number, patterns in ((1, validation), (2, test)):
        for pattern in patterns:
            pattern = plain_name(pattern)
            matching = [scene for scene, name in enumerate(names) if fnmatch.fnmatchcase(name, pattern)]
            if not matching:
                raise unknown_name("scene", pattern, names)
            if both := next((names[scene] for scene in matching if split[scene] not in (0, number)), None):
                raise InputError(f"the scene {quoted(both)} is named by --validation and by --test; name it once")
            split[matching] = number
    return split


def split_times(tracks: Tracks, scenes: int, shares: Shares) -> list[tuple[Tracks, Integers]]:
    """Return for each split the tracks in its block of frames, and the step (scenes,) at which the block begins.

    The blocks follow one another in each scene and share no frame.
    """
    begin, end = np.full(scenes, np.iinfo(np.int64).max), np.zeros(scenes, dtype=np.int64)
    np.minimum.at(begin, tracks.scene, tracks.begin)
    np.maximum.at(end, tracks.scene, tracks.begin + tracks.length)
    begin = np.minimum(begin, end)
    bounds = [begin + (end - begin) * sum(shares[:number]) // sum(shares) for number in range(len(SPLITS) + 1)]
    return [(tracks.between(one, other), one) for one, other in pairwise(bounds)]
