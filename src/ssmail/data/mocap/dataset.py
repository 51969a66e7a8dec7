"""The expert set of Noisy Mocap (section 4.1, B.3): trials of one subject of the CMU database, cut into windows.

The protocol is that of DNRI's authors (reading of the paper in docs/paper.md). With p the positions of a trial's F
frames, its locations are p[1:] and its velocities p[1:] - p[:-1]. Windows follow one another without overlap from the
first location on, and the rest that fills no window is dropped: they begin at range(0, F - window, window), with F the
number of *frames*, which makes every whole window of the F - 1 locations. (Counting locations instead would lose the
last window of a trial of 50 k + 1 frames; subject 35 has none, and both give 92, 33 and 27 windows.) Windows of the
test split are longer: half of one is observed and the rest predicted.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmail.config.sections import Frozen
from ssmail.data.mocap.acclaim_lines import AGAIN
from ssmail.data.mocap.amc import parse_motion
from ssmail.data.mocap.asf import Skeleton, parse_skeleton
from ssmail.data.mocap.kinematics import positions
from ssmail.data.mocap.source import Source, find_subject, open_source, shown
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import ExpertSet, Floats, Integers, Trajectories
from ssmail.errors import InputError

SPLITS = ("train", "validation", "test")
MOST_TRIALS = 1000
Trial = Annotated[int, Field(ge=1, lt=1_000_000)]
Trials = Annotated[tuple[Trial, ...], Field(min_length=1)]


class MocapParameters(Frozen):
    """What a set of recorded motion was made from: trials by number, windows in frames.

    missing: trials that were asked for but not there. length_unit: the multiplier in the head of the skeleton file,
    which is *not* applied; 2.54 / length_unit centimetres are one unit of the positions, in the CMU database.
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
        """Frames in a window of a split."""
        return self.test_window if split == "test" else self.window


def parse_trials(text: str, option: str) -> tuple[int, ...]:
    """The trials that an option names: "01-12" or "1-3,7". Raises InputError naming the option."""
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
    """The expert set made of the files in a folder or zip file; `missing` and `length_unit` of `wanted` are ignored.

    Trajectories are in the units of the skeleton file, (B, window, N, 3), with N joints in the order of that file and
    the root first; the order of trials is that of `wanted`.

    Raises InputError when a trial is named twice, a file is missing (unless `allow_missing`, which still needs one
    trial for each split), doubled, or not as it should be, and when a trial is too short for a window.
    """
    _check_trials(wanted)
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
        sources: dict[str, str] = {}
        skeleton = parse_skeleton(_read(files, subject.skeleton, sources), _label(files, subject.skeleton))
        splits = {}
        for split, trials in used.items():
            names = {trial: subject.trials[trial] for trial in trials}
            splits[split] = _split(files, names, skeleton, wanted.window_of(split), sources)
    made = wanted.model_copy(update={**used, "missing": missing, "length_unit": skeleton.length_unit})
    _check_scale(splits["train"], source)
    return make_expert_set(splits, made, skeleton.joints, skeleton.parents, sources)


def make_expert_set(
    splits: Mapping[str, Trajectories],
    params: MocapParameters,
    joints: tuple[str, ...],
    parents: tuple[int, ...],
    sources: Mapping[str, str],
) -> ExpertSet:
    """Bundle the splits with what they were made of and the hash of it. The sources are not in the hash: the same
    numbers with other line ends are the same data.
    """
    parameters = params.model_dump(mode="json")
    digest = hashlib.sha256(json.dumps([parameters, joints, parents], sort_keys=True).encode())
    for split in SPLITS:
        data = splits[split]
        for array in (data.positions, data.velocities, data.mode, data.trial, data.frame):
            digest.update(np.ascontiguousarray(array).tobytes())
    train, validation, test = (splits[split] for split in SPLITS)
    no_lines = np.empty((0, 0, 3))
    return ExpertSet(train, validation, test, no_lines, parameters, digest.hexdigest(), joints, parents, dict(sources))


def make_trajectories(locations: Floats, velocities: Floats, trial: Integers, frame: Integers) -> Trajectories:
    """Windows (B, T, N, 3) as trajectories of a single mode, whose continuation is the window itself."""
    mode = np.zeros(len(locations), dtype=np.int64)
    return Trajectories(locations, velocities, mode, locations[None], trial, frame)


def _check_trials(wanted: MocapParameters) -> None:
    """Whether every trial is named once: one that is trained on must not be tested on."""
    seen: dict[int, str] = {}
    for split in SPLITS:
        for trial in getattr(wanted, split):
            if trial in seen:
                where = f"twice in {split}" if seen[trial] == split else f"in {seen[trial]} and in {split}"
                raise InputError(f"trial {trial:02d} is {where}; name each trial once")
            seen[trial] = split


def _lack(source: Path, subject: int, missing: Iterable[int]) -> str:
    names = ", ".join(f"{subject:02d}_{trial:02d}.amc" for trial in missing)
    return f"{source} lacks {names}"


def _split(
    files: Source, names: Mapping[int, str], skeleton: Skeleton, window: int, sources: dict[str, str]
) -> Trajectories:
    """The windows of some trials, one after the other; `sources` gains their checksums."""
    parts: list[tuple[Floats, Floats]] = []
    trials: list[int] = []
    frames: list[int] = []
    for trial, name in names.items():
        label = _label(files, name)
        motion = parse_motion(_read(files, name, sources), label, skeleton)
        if len(motion) <= window:
            raise InputError(
                f"{label} has {len(motion)} frames, too few for a window of {window} and one before it; "
                f"leave trial {trial:02d} out"
            )
        placed = positions(skeleton, motion)
        starts = range(0, len(motion) - window, window)
        index = np.add.outer(starts, np.arange(window))  # (windows, window)
        parts.append((placed[1:][index], np.diff(placed, axis=0)[index]))
        trials += [trial] * len(starts)
        frames += [motion.first + 1 + start for start in starts]
    locations, velocities = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return make_trajectories(locations, velocities, np.array(trials), np.array(frames))


def _check_scale(train: Trajectories, source: Path) -> None:
    try:
        Scaling.fit(train.positions, train.velocities)
    except ValueError:
        raise InputError(f"nothing moves in the training trials of {source}; {AGAIN}") from None


def _read(files: Source, name: str, sources: dict[str, str]) -> bytes:
    contents = files.read(name)
    sources[name] = hashlib.sha256(contents).hexdigest()
    return contents


def _label(files: Source, name: str) -> str:
    return shown(str(files.path / name))


def parameters_from(text: Any) -> MocapParameters:
    """The parameters inside a file. Raises ValueError."""
    return MocapParameters.model_validate_json(str(text))
