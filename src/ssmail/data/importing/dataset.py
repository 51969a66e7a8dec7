"""Import anyone's recorded agents: from files to an expert set (docs/data-format.md)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ssmail.data.importing.cutting import Windows, check_size, cut, longest, nearest
from ssmail.data.importing.rows import Rows, quoted
from ssmail.data.importing.sources import find_files, read_files
from ssmail.data.importing.splitting import Shares, named_scenes, split_scenes, split_times
from ssmail.data.importing.summary import Summary, fastest_step, summarize
from ssmail.data.importing.tables import Columns
from ssmail.data.importing.tracks import Tracks, make_tracks
from ssmail.data.recorded_sets import SetParameters, recorded_set, windows
from ssmail.data.trajectories import SPLITS, ExpertSet, Integers, Trajectories
from ssmail.errors import InputError


@dataclass(frozen=True)
class ImportOptions:
    """How rows become windows. observed: of a window, half of it by default. stride: by default what is predicted.

    most_agents: of a window; None for all. validation, test: patterns of the names of these scenes, instead of the
    shares of `split`. same_agents: whether row n of all windows is the same agent; None for yes if all windows have
    agents of the same names. The other fields are those of SetParameters.
    """

    columns: Columns = field(default_factory=Columns)
    dt: float | None = None
    window: int = 50
    observed: int | None = None
    stride: int | None = None
    fill_gaps: int = 0
    least_agents: int = 1
    most_agents: int | None = None
    split: Shares = (70, 15, 15)
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    same_agents: bool | None = None

    def parameters(self, axes: int) -> SetParameters:
        """Return the parameters of a set. Raises InputError unless something of a window is observed and predicted."""
        observed = self.window // 2 if self.observed is None else self.observed
        if not 1 <= observed < self.window:
            raise InputError(
                f"of a window of {self.window} frames, {observed} cannot be observed; give --observed from 1 to "
                f"{self.window - 1}, or another --window"
            )
        if self.most_agents is not None and self.most_agents < self.least_agents:
            raise InputError(f"--agents {self.most_agents} is less than --least-agents {self.least_agents}; swap them")
        if bool(self.validation) != bool(self.test):
            raise InputError("--validation and --test name scenes together; give both, or --split")
        return SetParameters(
            axes=axes,
            window=self.window,
            observed=observed,
            predicted=self.window - observed,
            stride=self.stride or self.window - observed,
            dt=self.dt,
            fill_gaps=self.fill_gaps,
            least_agents=self.least_agents,
            most_agents=self.most_agents,
            split=self.split,
        )


def import_set(
    sources: Sequence[Path],
    options: ImportOptions,
    report: Callable[[str], None] = lambda _: None,
    out: Path | None = None,
) -> tuple[ExpertSet, Summary]:
    """Make an expert set from files, or from all those in folders. report: is told of large files, and of `out` if it
    is left out because it lies in such a folder.

    Raises InputError for anything in the files that cannot be used, and if there is no window for each split.
    """
    options.parameters(1)  # refuse what cannot be before files are read
    files = find_files(sources, report, out)
    rows, digests = read_files(files, options.columns, report)
    return set_of_rows(rows, options, quoted(sources[0], 80), digests)


def set_of_rows(
    rows: Rows, options: ImportOptions, label: str, digests: Mapping[str, str] | None = None
) -> tuple[ExpertSet, Summary]:
    """Make an expert set from rows. label: what they come from, in messages. digests: the SHA-256 of their files.

    Raises InputError for rows that cannot be used, and if there is no window for each split.
    """
    params = options.parameters(rows.positions.shape[1])
    tracks, repairs = make_tracks(rows, options.dt, options.fill_gaps)
    parts, params = _parts(tracks, rows.scenes, params, options)
    if params.most_agents is not None:
        parts = [nearest(part, params.most_agents, params.observed) for part in parts]
    agents = max(int(part.agents.max()) for part in parts)
    check_size(parts, agents)
    params = params.model_copy(update={"identity": _same_agents(parts, rows, options.same_agents)})
    used, numbers = np.unique(np.concatenate([part.scene for part in parts]), return_inverse=True)
    scenes = [rows.scenes[scene] for scene in used]
    splits, begin = {}, 0
    for split, part in zip(SPLITS, parts, strict=True):
        splits[split] = _trajectories(part, agents, numbers[begin : begin + len(part)])
        begin += len(part)
    experts = recorded_set(splits, scenes, params, digests)
    experts.check_scaling(
        *(label, "are these the right columns, and all in the same unit?"),
        lambda: f": leave out errors such as the fastest step, {fastest_step(tracks, rows)}",
    )
    return experts, summarize(rows, tracks, repairs, parts, params)


def _parts(
    tracks: Tracks, scenes: Sequence[str], params: SetParameters, options: ImportOptions
) -> tuple[list[Windows], SetParameters]:
    """Cut the windows of each split, and return them with the parameters that say how it was split."""
    frames, stride, least = params.window + 1, params.stride, params.least_agents
    start = np.zeros(len(scenes), dtype=np.int64)
    found = np.bincount(cut(tracks, start, frames, stride, least).scene, minlength=len(scenes))
    split_by: Literal["scene", "time", "name"] = "scene"
    if options.test:
        split_by, split = "name", named_scenes(scenes, options.validation, options.test)
    elif np.count_nonzero(found) >= len(SPLITS):
        split = np.maximum(split_scenes(scenes, found, params.split), 0)  # of scenes without windows, any
    else:
        split_by = "time"
    if split_by == "time":
        blocks = split_times(tracks, len(scenes), params.split)
    else:
        blocks = [(tracks[split[tracks.scene] == number], start) for number in range(len(SPLITS))]
    parts = [cut(part, begin, frames, stride, least) for part, begin in blocks]
    params = params.model_copy(update={"split_by": split_by})
    if not all(map(len, parts)):
        raise _no_window(tracks, blocks, params)
    return parts, params


def _no_window(tracks: Tracks, blocks: Sequence[tuple[Tracks, Integers]], params: SetParameters) -> InputError:
    """Return what to say if a split has no window, with the longest that all could have."""
    together = f"{params.least_agents} agents together" if params.least_agents > 1 else "an agent without a gap"
    most = min(int(longest(part, params.least_agents).max(initial=0)) for part, _ in blocks) - 1
    if params.split_by == "time" and len(tracks.first) >= len(SPLITS):  # three scenes might have shorter windows
        most = max(most, int(np.sort(longest(tracks, params.least_agents))[-len(SPLITS)]) - 1)
    if most >= params.window:
        return InputError(
            f"no window of {params.window} frames begins where --stride {params.stride} looks for it; lower --stride"
        )
    if most < 2:
        return InputError(
            f"the three splits cannot each have {together} for 3 frames; raise --fill-gaps, or add more scenes"
        )
    return InputError(
        f"the three splits cannot each have windows of {params.window} frames, and one before, with {together}; the "
        f"longest possible is --window {most}"
    )


def _same_agents(parts: Sequence[Windows], rows: Rows, wanted: bool | None) -> bool:
    """Return whether the agents count as the same ones in all windows: as wanted, or by their names.

    Raises InputError, with an agent that is missing somewhere, if that is wanted of windows with different names.
    """
    names, numbers, scenes = (
        np.concatenate([getattr(part, field) for part in parts]) for field in ("names", "agents", "scene")
    )
    alike = bool((numbers == numbers[0]).all() and (names.reshape(len(numbers), -1) == names[: numbers[0]]).all())
    if wanted and not alike:
        groups = np.split(names, np.cumsum(numbers)[:-1])
        other = next(window for window, group in enumerate(groups) if not np.array_equal(group, groups[0]))
        agent = np.setxor1d(groups[0], groups[other])[0]
        there, missing = (0, other) if agent in groups[0] else (other, 0)
        raise InputError(
            f"--same-agents: agent {quoted(rows.agents[agent])} is in a window of scene "
            f"{quoted(rows.scenes[scenes[there]])}, but not in one of scene {quoted(rows.scenes[scenes[missing]])}; "
            "name the agents alike, choose windows that all have them, or leave the option out"
        )
    return alike if wanted is None else wanted


def _trajectories(part: Windows, agents: int, scene: Integers) -> Trajectories:
    tracks = part.tracks
    frame = tracks.first[part.scene] + (part.begin + 1) * tracks.step[part.scene]
    return windows(part.positions(agents), part.agents, scene, frame)
