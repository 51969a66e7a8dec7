"""The expert set of Noisy Mocap (section 4.1, B.3): trials of one subject of the CMU database, cut into windows.

The protocol is that of DNRI's authors (docs/paper.md). A trial with positions p of F frames has the locations p[1:] and
the velocities p[1:] - p[:-1]. Windows follow one another without overlap from the first location on, and a rest that
fills no window is dropped. They begin at range(0, F - window, window), where F counts *frames*, so that every whole
window of the F - 1 locations is used. (Counting locations would lose the last window of a trial of 50 k + 1 frames;
subject 35 has no such trial, and both yield 92, 33 and 27 windows.) Windows of the test split are longer: half of a
window is observed and the rest predicted.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ssmail.config.value_types import Frozen
from ssmail.data.mocap.acclaim_lines import AGAIN
from ssmail.data.mocap.amc import MOST_PLACES, parse_motion
from ssmail.data.mocap.asf import Skeleton, parse_skeleton
from ssmail.data.mocap.kinematics import positions
from ssmail.data.mocap.source import Source, find_subject, open_source, shown
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats, Trajectories
from ssmail.errors import InputError

MOST_TRIALS = 1000
MOST_SHOWN = 8  # missing trials in a message
NO_LINES = np.empty((0, 0, 3))  # the centre lines of recorded motion
Trial = Annotated[int, Field(ge=1, lt=1_000_000)]
Trials = Annotated[tuple[Trial, ...], Field(min_length=1)]


class MocapParameters(Frozen):
    """What a set of recorded motion is made from: trials by number, windows in frames.

    missing: requested trials that the source lacks. length_unit: the multiplier in the header of the skeleton file,
    which is *not* applied; in the CMU database, one unit of the positions is 2.54 / length_unit centimetres.
    """

    environment: Literal["mocap"] = "mocap"
    subject: Trial
    train: Trials
    validation: Trials
    test: Trials
    missing: tuple[Trial, ...] = ()
    window: Annotated[int, Field(ge=2)] = 50
    test_window: Annotated[int, Field(ge=2)] = 100
    length_unit: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0

    def window_of(self, split: str) -> int:
        """Return the number of frames in a window of a split."""
        return self.test_window if split == "test" else self.window


def parse_trials(text: str, option: str) -> tuple[int, ...]:
    """Parse the trials that an option names: "01-12" or "1-3,7". Raises InputError that names the option."""
    trials: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?", part, re.ASCII)
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
        if first < 1 or len(text) > MOST_TRIALS:
            raise InputError(f"{option} takes trials such as 01-12 or 1-3,7, not {text[:40]!r}")
        if last < first:
            raise InputError(f"the range {first:02d}-{last:02d} in {option} runs backwards; swap its ends")
        if len(trials) + last - first >= MOST_TRIALS:
            raise InputError(f"{option} names more than {MOST_TRIALS} trials; name fewer")
        trials += range(first, last + 1)
    return tuple(trials)


def prepare(source: Path, wanted: MocapParameters, *, allow_missing: bool = False) -> ExpertSet:
    """Make the expert set from the files in a folder or zip file; `missing` and `length_unit` of `wanted` are ignored.

    Trajectories are (B, window, N, 3) in the units of the skeleton file, the root first and then the joints in the
    order of that file; trials come in the order of `wanted`.

    Raises InputError if a trial is named twice, if a file is missing (`allow_missing` still needs one trial for each
    split), duplicated or malformed, and if a trial is too short for a window.
    """
    _check_trials(wanted)
    # choose the trials
    asked = {split: getattr(wanted, split) for split in SPLITS}
    with open_source(source) as files:
        subject = find_subject(files, wanted.subject, (trial for trials in asked.values() for trial in trials))
        missing = tuple(trial for trials in asked.values() for trial in trials if trial not in subject.trials)
        if missing and not allow_missing:
            raise InputError(f"{_lack(source, wanted.subject, missing)}; add them, or insist with --allow-missing")
        used = {split: tuple(t for t in trials if t not in missing) for split, trials in asked.items()}
        for split, trials in used.items():
            if not trials:
                raise InputError(f"{_lack(source, wanted.subject, missing)}, so nothing is left to {split}; add them")
        # read the skeleton and the motions, and cut them into windows
        sources: dict[str, str] = {}
        skeleton = parse_skeleton(_read(files, subject.skeleton, sources), _label(files, subject.skeleton))
        splits = {}
        for split, trials in used.items():
            names = {trial: subject.trials[trial] for trial in trials}
            splits[split] = _split(files, names, skeleton, wanted.window_of(split), sources)
    made = wanted.model_copy(update={**used, "missing": missing, "length_unit": skeleton.length_unit})
    experts = ExpertSet.bundle(
        splits, NO_LINES, made.model_dump(mode="json"), skeleton.joints, skeleton.parents, sources
    )
    experts.check_scaling(str(source), AGAIN)
    return experts


def _check_trials(wanted: MocapParameters) -> None:
    """Raise InputError if a trial is named twice: the test split must not contain a training trial."""
    seen: dict[int, str] = {}
    for split in SPLITS:
        for trial in getattr(wanted, split):
            if trial in seen:
                where = f"twice in {split}" if seen[trial] == split else f"in {seen[trial]} and in {split}"
                raise InputError(f"trial {trial:02d} is {where}; name each trial once")
            seen[trial] = split


def _lack(source: Path, subject: int, missing: Sequence[int]) -> str:
    names = ", ".join(f"{subject:02d}_{trial:02d}.amc" for trial in missing[:MOST_SHOWN])
    more = len(missing) - MOST_SHOWN
    return f"{source} lacks {names}{f' and {more} more trials' if more > 0 else ''}"


def _split(
    files: Source, names: Mapping[int, str], skeleton: Skeleton, window: int, sources: dict[str, str]
) -> Trajectories:
    """Cut trials into windows, one trial after the other, and add the digests of their files to `sources`."""
    parts: list[tuple[Floats, Floats]] = []
    trials: list[int] = []
    frames: list[int] = []
    places = 0
    for trial, name in names.items():
        label = _label(files, name)
        motion = parse_motion(_read(files, name, sources), label, skeleton)
        if len(motion) <= window:
            raise InputError(
                f"{label} has {len(motion)} frames, too few for a window of {window} and one before it; "
                f"leave trial {trial:02d} out"
            )
        places += motion.angles.shape[0] * motion.angles.shape[1]
        if places > MOST_PLACES:
            raise InputError(f"{label} and those before it have too many frames for one set; name fewer trials")
        placed = positions(skeleton, motion)  # (F, N, 3)
        starts = range(0, len(motion) - window, window)
        index = np.add.outer(starts, np.arange(window))  # (windows, window)
        parts.append((placed[1:][index], np.diff(placed, axis=0)[index]))
        trials += [trial] * len(starts)
        frames += [motion.first + 1 + start for start in starts]
    locations, velocities = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Trajectories.single_mode(locations, velocities, np.array(trials), np.array(frames))


def _read(files: Source, name: str, sources: dict[str, str]) -> bytes:
    contents = files.read(name)
    sources[name] = hashlib.sha256(contents).hexdigest()
    return contents


def _label(files: Source, name: str) -> str:
    return shown(str(files.path / name))
