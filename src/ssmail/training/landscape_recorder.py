"""Looking at the reward that a learner climbs while it learns: over the plane, and around the current trajectory.

Only planar environments and methods that learn a reward have landscapes. Looking changes nothing: the rollouts have a
generator of their own, the same in every look.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from ssmail.config.spec import RunSpec
from ssmail.evaluation.landscape import Plane, closeness, mean_cosine, nearest_points, slope_share
from ssmail.losses.self_supervision import mix, nearest
from ssmail.models.features import Features
from ssmail.training.experts import as_doubles
from ssmail.training.learning import Learner, Predictor, Setting

REFERENCES = 2  # training trajectories whose states stand in for what a point of the plane leaves open
STATES = 24  # of a reference, evenly over its steps
SHOWN = 16  # training trajectories that pictures show
ROLLOUTS = 8  # current trajectories, from the starts of the first of the references
CURRENT = 0.5  # the fraction of the epochs after which the policy is "the current one" of Figure 2
BEHIND = tuple(-a / 8 for a in range(8, 0, -1))  # alphas of the points behind the current trajectory
AHEAD = tuple(a / 8 for a in range(8))  # and of those on it and before it

Arrays = dict[str, np.ndarray]


@runtime_checkable
class RewardLearner(Protocol):
    """A learner whose policy climbs a reward that it learns too."""

    features: Features

    @property
    def predictor(self) -> Predictor:
        """The policy."""
        ...

    def reward(self, x: Tensor, actions: Tensor) -> Tensor:
        """(..., N) what the actor-critic is given for features (..., N, F) and actions (..., N, A)."""
        ...


def looks(spec: RunSpec) -> tuple[int, ...]:
    """The epochs after which a landscape is kept, rising: 0 is the untrained model."""
    kept = spec.evaluation.landscapes or 1
    even = (round(spec.epochs * k / kept) for k in range(kept + 1))
    return tuple(sorted({*even, current_epoch(spec)}))


def current_epoch(spec: RunSpec) -> int:
    """The epoch after which the policy is "the current one" of Figure 2."""
    return max(1, round(CURRENT * spec.epochs))


@dataclass(frozen=True)
class Moments:
    """Moments (...) of a group: its states (..., N, D) in scaled units, what is read beside them (..., N, F - D), and
    the actions (..., N, A) as they are read.
    """

    states: Tensor
    beside: Tensor
    actions: Tensor

    @classmethod
    def of(cls, features: Features, states: Tensor, actions: Tensor) -> "Moments":
        """Those of trajectories: states (B, T + 1, N, D), of which the last is left out, and actions (B, T, N, A)."""
        beside = features(states[:, :-1], states[:, 0])[..., states.shape[-1] :]
        return cls(states[:, :-1], beside, features.of_actions(actions))


def position_gradient(learner: RewardLearner, at: Moments, agent: int) -> tuple[Tensor, Tensor]:
    """The agent's reward (...) at moments (...) and its gradient (..., 2) with respect to the agent's own position,
    everything else held.
    """
    position = at.states[..., agent, :2].detach().clone().requires_grad_()
    moved = at.states.detach().clone()
    moved[..., agent, :2] = position
    x = torch.cat([learner.features.read(moved), at.beside], dim=-1)
    values = learner.reward(x, at.actions)[..., agent]
    (gradient,) = torch.autograd.grad(values.sum(), position)
    return values.detach(), gradient


class Landscapes:
    """What is seen of one run. All arrays are scaled but for those whose names say otherwise."""

    def __init__(self, setting: Setting, learner: RewardLearner) -> None:
        self.setting, self.learner = setting, learner
        experts = setting.experts
        chosen = torch.as_tensor(_spread(len(experts), REFERENCES), device=setting.device)
        steps = torch.as_tensor(_spread(setting.steps, STATES), device=setting.device)
        states = experts.states[chosen]
        all_steps = Moments.of(learner.features, states, experts.actions[chosen])
        self.references = Moments(*(part[:, steps].flatten(0, 1) for part in vars(all_steps).values()))  # (K)
        self.agents = states.shape[2]
        everywhere = as_doubles(experts.states[..., :2])  # (B, T + 1, N, 2)
        self.plane = Plane.around(everywhere)
        points, tracks = self.plane.points, [everywhere[:, :, n].reshape(-1, 2) for n in range(self.agents)]
        self.ways = np.stack([nearest_points(points, track) - points for track in tracks])
        places = [as_doubles(self.references.states[:, n, :2]) for n in range(self.agents)]
        self.weights = torch.as_tensor(np.stack([closeness(points, place) for place in places]))

    @classmethod
    def of(cls, setting: Setting, learner: Learner) -> "Landscapes | None":
        """Those of a learner, or None where there is no plane or no reward."""
        planar = setting.experts.actions.shape[-1] == 2
        return cls(setting, learner) if planar and isinstance(learner, RewardLearner) else None

    def look(self, epoch: int) -> tuple[dict[str, float], Arrays]:
        """The numbers and the arrays of the model as it is after `epoch` epochs; see docs/database.md."""
        made = self.rollouts()
        reward, gradient = self.field()
        prefix = f"landscape/{epoch:04d}"
        arrays = {
            f"{prefix}/reward": _half(reward),
            f"{prefix}/gradient": _half(gradient),
            f"{prefix}/rollouts": _half(self._raw(made)),
        }
        if epoch == 0:
            return {}, {**self._frame(), **arrays}
        values = {
            "landscape/slope_share": slope_share(reward, gradient, self.plane),
            "landscape/cosine": mean_cosine(gradient, self.ways, self.plane.spacing),
        }
        if epoch == current_epoch(self.setting.spec):
            more, around = self.around(made)
            values, arrays = values | more, arrays | around
        return values, arrays

    def field(self) -> tuple[np.ndarray, np.ndarray]:
        """The reward (N, H, W) of each agent over the plane and its gradient (N, H, W, 2).

        The agent is put on each point; all else is that of the nearest of its own positions in the references.
        """
        known = self.references
        points = torch.as_tensor(self.plane.points, dtype=known.states.dtype, device=known.states.device)
        here = [part.expand(*points.shape[:2], *part.shape) for part in vars(known).values()]  # (H, W, K)
        rewards, gradients = [], []
        for agent, weights in enumerate(self.weights):
            states = here[0].clone()
            states[..., agent, :2] = points.unsqueeze(2)
            reward, gradient = position_gradient(self.learner, Moments(states, *here[1:]), agent)
            rewards.append((weights * _double(reward)).sum(dim=2))
            gradients.append((weights.unsqueeze(-1) * _double(gradient)).sum(dim=2))
        return torch.stack(rewards).numpy(), torch.stack(gradients).numpy()

    def rollouts(self) -> Tensor:
        """(ROLLOUTS, T + 1, N, D) states of the current policy, sampled, from the starts of some references."""
        generator = torch.Generator().manual_seed(self.setting.generators.seeds["evaluation"])
        starts = self.setting.experts.states[_spread(len(self.setting.experts), ROLLOUTS), :1]
        return self.learner.predictor.free_run(starts, self.setting.steps, generator)

    def around(self, made: Tensor) -> tuple[dict[str, float], Arrays]:
        """The gradient at the states and actions of tau_alpha, between the rollouts `made` and the expert trajectory
        nearest to each: its mean cosine with the way to that expert's position at the same step, and the arrays.
        """
        experts = self.setting.experts[nearest(made, self.setting.experts.states)]
        alphas = torch.tensor([*BEHIND, *AHEAD], device=made.device)
        count, rollouts = len(alphas), len(made)
        each = alphas.repeat_interleave(rollouts)
        states = mix(made.repeat(count, 1, 1, 1), experts.states.repeat(count, 1, 1, 1), each)
        taken = made[:, 1:, :, 2:]  # the environment's actions are the next velocities
        actions = mix(taken.repeat(count, 1, 1, 1), experts.actions.repeat(count, 1, 1, 1), each)
        at = Moments.of(self.learner.features, states, actions)
        found = [position_gradient(self.learner, at, agent)[1] for agent in range(self.agents)]
        gradient = as_doubles(torch.stack(found, dim=2)).reshape(count, rollouts, -1, self.agents, 2)
        here = as_doubles(states[:, :-1, :, :2]).reshape(gradient.shape)
        ways = as_doubles(experts.states[:, :-1, :, :2]) - here
        behind = slice(len(BEHIND))
        values = {
            "landscape/behind_cosine": mean_cosine(gradient[behind], ways[behind], self.plane.spacing),
            "landscape/ahead_cosine": mean_cosine(gradient[len(BEHIND) :], ways[len(BEHIND) :], self.plane.spacing),
        }
        arrays = {
            "vector_field/alpha": as_doubles(alphas),
            "vector_field/gradient": _half(gradient),
            "vector_field/current": self._raw(made[:, :-1]),
            "vector_field/expert": self._raw(experts.states[:, :-1]),
        }
        return values, arrays

    def _frame(self) -> Arrays:
        """What all looks share, in raw units: the axes of the plane, the length of a scaled unit, some experts."""
        scaling = self.setting.integrator.scaling
        axes = {name: scaling.unscale_positions(getattr(self.plane, name)).astype(np.float32) for name in ("x", "y")}
        expert = self._raw(self.setting.experts.states[_spread(len(self.setting.experts), SHOWN)])
        unit = np.array([scaling.position_span / 2])
        return {"landscape/x": axes["x"], "landscape/y": axes["y"], "landscape/unit": unit, "landscape/expert": expert}

    def _raw(self, states: Tensor) -> np.ndarray:
        """Raw positions (..., 2) of scaled states."""
        raw: np.ndarray = self.setting.integrator.scaling.unscale_positions(as_doubles(states[..., :2])).astype(
            np.float32
        )
        return raw


def _spread(length: int, count: int) -> np.ndarray:
    """Up to `count` indices, evenly from the first of `length` to the last."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(int)


def _double(tensor: Tensor) -> Tensor:
    return tensor.double().cpu()


def _half(values: np.ndarray) -> np.ndarray:
    """For pictures: three digits, and within the finite numbers of float16 whatever is finite."""
    largest = np.finfo(np.float16).max
    finite = np.isfinite(values)
    return np.where(finite, np.clip(values, -largest, largest), values).astype(np.float16)
