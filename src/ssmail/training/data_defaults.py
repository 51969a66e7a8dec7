"""What a spec leaves to the data: keys that are null or "auto" get their values from the training split.

The reach of actions, which each axis has of its own, is left to `ssmail.models.normalization.ActionBounds`.
"""

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor

from ssmail.config.sections import ForecastSpec, ModelSpec, VariationalSpec
from ssmail.config.spec import RunSpec
from ssmail.data.trajectories import ExpertSet
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError
from ssmail.training.batches import Batch, to_numpy

WINDOWS_A_PLACE = 10  # absolute positions need so many training windows wherever a group may be
NOISE_SHARE = 0.1  # standard deviation that the policy's noise aims at, as a fraction of the rms change of velocity
VARIANCE_SHARE = 0.1  # of the likelihood, as a fraction of constant velocity's squared error after one step
MISS_SHARE = 0.2  # distance of a miss, as a fraction of the mean distance covered in the predicted frames
SMALLEST = 1e-6  # of all of these, in scaled units, for data in which nothing changes

Network = TypeVar("Network", ModelSpec, VariationalSpec)


def resolve(spec: RunSpec, data: ExpertSet, experts: Sequence[Batch]) -> RunSpec:
    """Return the spec with a value for each key that is "auto", or null and decided by the data.

    experts: the training split, scaled, for each number of agents. Raises InputError for keys that need the agents to
    be the same ones in all trajectories, and for forecast frames that the set does not state.
    """
    changed: dict[str, BaseModel] = {}
    if spec.model:
        changed["model"] = _inputs("model", spec.model, data, experts)
    if spec.sac and spec.sac.target_entropy is None:
        changed["sac"] = spec.sac.model_copy(update={"target_entropy": _target_entropy(experts)})
    if spec.variational:
        variational = _inputs("variational", spec.variational, data, experts)
        if variational.variance is None:
            error = _constant_velocity_error(Integrator(data.scaling), experts)
            variational = variational.model_copy(update={"variance": max(VARIANCE_SHARE * error, SMALLEST**2)})
        changed["variational"] = variational
    if spec.forecast:
        changed["forecast"] = _forecast(spec.forecast, data)
    return spec.model_copy(update=changed)


def forecast_frames(forecast: ForecastSpec, data: ExpertSet) -> tuple[int, int]:
    """Return how many frames are observed and predicted. Raises InputError if neither the spec nor the set says it."""
    frames = []
    for key in ("observed", "predicted"):
        count = getattr(forecast, key) or data.parameters.get(key)
        if not isinstance(count, int):
            raise InputError(
                f"this set of {data.environment} does not say how many frames are {key}; set forecast.{key}."
            )
        frames.append(count)
    return frames[0], frames[1]


def wanders(experts: Sequence[Batch]) -> bool:
    """Return whether groups are seen in so many places that few training windows tell about each.

    A place is as large as the root mean square distance of the agents of a window from its centre, along each axis; a
    set has as many places as the centres of its windows spread over.
    """
    centres, within = [], []
    for batch in experts:
        positions = to_numpy(batch.states[..., : batch.actions.shape[-1]])
        centre = positions.mean(axis=(1, 2))
        centres.append(centre)
        within.append(np.square(positions - centre[:, None, None]).mean(axis=(1, 2)))
    spread = np.concatenate(centres).std(axis=0)
    size = np.sqrt(np.concatenate(within).mean(axis=0))
    places = float(np.prod(np.maximum(spread / np.maximum(size, SMALLEST), 1)))
    return sum(map(len, centres)) < WINDOWS_A_PLACE * places


def _inputs(name: str, section: Network, data: ExpertSet, experts: Sequence[Batch]) -> Network:
    """Return a section of a network with what it reads decided."""
    same = bool(data.parameters.get("identity", True))
    for key, remedy in (("agent_input", "false"), ("standardize", "pooled")):
        if getattr(section, key) is True and not same:
            raise InputError(
                f"{name}.{key} needs the same agents in all scenes, and this set does not have them; "
                f"set {name}.{key}={remedy}."
            )
    updates: dict[str, Any] = {}
    if section.agent_input == "auto":
        updates["agent_input"] = same
    if section.standardize == "auto":
        updates["standardize"] = same or "pooled"
    if section.centre_relative == "auto":
        updates["centre_relative"] = not section.root_relative and wanders(experts)
    return section.model_copy(update=updates)


def _target_entropy(experts: Sequence[Batch]) -> float:
    """Return the entropy of an axis, in nats, of Gaussian noise with NOISE_SHARE of the rms change of velocity."""
    changes = torch.cat([_velocities(batch).diff(dim=1).flatten(0, 2) for batch in experts]).double()
    std = (NOISE_SHARE * changes.square().mean(dim=0).sqrt()).clamp(min=SMALLEST)
    return float(std.log().mean()) + 0.5 * math.log(2 * math.pi * math.e)


def _constant_velocity_error(integrator: Integrator, experts: Sequence[Batch]) -> float:
    """Return the mean squared error of a step of constant velocity, over all features, in scaled units."""
    errors = []
    for batch in experts:
        now, velocities = batch.states[:, :-1], _velocities(batch)[:, :-1]
        errors.append((integrator.step(now, velocities) - batch.states[:, 1:]).square().flatten())
    return float(torch.cat(errors).double().mean())


def _forecast(forecast: ForecastSpec, data: ExpertSet) -> ForecastSpec:
    """Return the section with the frames and the distance of a miss decided."""
    observed, predicted = forecast_frames(forecast, data)
    updates: dict[str, Any] = {"observed": observed, "predicted": predicted}
    if forecast.miss_distance is None:
        train = data.train.positions
        last = min(observed + predicted, train.shape[1]) - 1
        covered = np.linalg.norm(train[:, last] - train[:, min(observed, last) - 1], axis=-1)  # (B, N)
        present = data.train.present
        mean = float(covered.mean() if present is None else covered[present[:, 0, :, 0]].mean())
        updates["miss_distance"] = max(MISS_SHARE * mean, SMALLEST)
    return forecast.model_copy(update=updates)


def _velocities(batch: Batch) -> Tensor:
    return batch.states[..., batch.actions.shape[-1] :]
