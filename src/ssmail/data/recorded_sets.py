"""Expert sets of the environment `trajectories`: windows of anyone's recorded agents (docs/data-format.md)."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ssmail.config.value_types import Frozen
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats, Integers, Trajectories

LONGEST_NAME = 200  # characters of the name of a scene
Count = Annotated[int, Field(ge=1)]


class SetParameters(Frozen):
    """What the windows of a set have in common, and how they were cut.

    format: the version of the file format. axes: P. window: T, the states of a window; the first `observed` are given
    to a forecast, the other `predicted` are compared with it. stride: steps from one window of a scene to the next. dt:
    seconds of a step, if known. identity: whether row n is the same agent in all windows. fill_gaps: missing frames of
    an agent that were interpolated at most. least_agents, most_agents: limits of the agents of a window. split: the
    shares of training, validation and test. split_by: "scene" if scenes were dealt out by these shares, "name" if they
    were chosen by their names, "time" if the frames of each scene were cut into three blocks.
    """

    environment: Literal["trajectories"] = "trajectories"
    format: Literal[1] = 1
    axes: Annotated[int, Field(ge=1, le=3)]
    window: Annotated[int, Field(ge=2)]
    observed: Count
    predicted: Count
    stride: Count
    dt: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    identity: bool = False
    fill_gaps: Annotated[int, Field(ge=0)] = 0
    least_agents: Count = 1
    most_agents: Count | None = None
    split: tuple[Count, Count, Count] = (70, 15, 15)
    split_by: Literal["scene", "time", "name"] = "scene"

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if self.observed + self.predicted != self.window:
            raise ValueError("observed and predicted are not the window")
        return self


def windows(frames: Floats, agents: Integers, scene: Integers, frame: Integers) -> Trajectories:
    """Return B windows of T states from the positions (B, T + 1, N, P) of their frames and of the one before.

    The frame before gives the first velocity. agents: (B,) how many of the N each window has; what follows them is set
    to zero. scene: (B,) the index of the scene. frame: (B,) the number of the first of the T frames.
    """
    beyond = np.arange(frames.shape[2]) >= agents[:, None]  # (B, N)
    if beyond.any():
        frames = np.where(beyond[:, None, :, None], 0.0, frames)
    return Trajectories.single_mode(frames[:, 1:], np.diff(frames, axis=1), None, frame, agents, scene)


def recorded_set(
    splits: Mapping[str, Trajectories],
    scenes: Sequence[str],
    parameters: SetParameters,
    sources: Mapping[str, str] | None = None,
) -> ExpertSet:
    """Put the windows of the three splits together. scenes: the names that `Trajectories.scene` counts.

    Raises ValueError, with what is wrong, if a window has no agents or something beside them, if a name is not proper,
    or if a scene is in two splits though the parameters say otherwise.
    """
    if len(set(scenes)) < len(scenes) or not all(0 < len(n) <= LONGEST_NAME and n.isprintable() for n in scenes):
        raise ValueError("the scenes have no proper names")
    used: dict[str, set[int]] = {}
    for split in SPLITS:
        found = splits[split]
        assert found.agents is not None
        assert found.present is not None
        assert found.scene is not None
        used[split] = set(found.scene.tolist())
        if found.agents.min() < 1:
            raise ValueError(f"a window of {split} has no agents")
        if any(array.any(where=~found.present) for array in (found.positions, found.velocities)):
            raise ValueError(f"a window of {split} has positions beside those of its agents")
    if parameters.split_by != "time":
        for one, other in combinations(SPLITS, 2):
            if shared := used[one] & used[other]:
                raise ValueError(f"the scene {scenes[min(shared)]!r:.40} is both in {one} and in {other}")
    centre_lines = np.empty((0, 0, parameters.axes))
    return ExpertSet.bundle(
        splits, centre_lines, parameters.model_dump(mode="json"), sources=sources, scenes=tuple(scenes)
    )
