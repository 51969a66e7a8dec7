"""Landscapes of the learned reward during training: over the plane, and around the current trajectory.

Only adversarial learners in planar environments have landscapes, and only if the spec asks for them. Recording one does
not change training: its rollouts use their own generator, which starts from the same seed every time.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ssmail.config.spec import RunSpec
from ssmail.evaluation.landscape import Plane, closeness, mean_cosine, nearest_points, slope_share
from ssmail.losses.self_supervision import mix, nearest
from ssmail.models.features import Features
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.batches import Arrays, to_numpy
from ssmail.training.learner import Learner, LearnerContext

REFERENCES = 2  # training trajectories that supply everything but the agent's position at a point of the plane
REFERENCE_STATES = 24  # of each reference, evenly over its steps
EXPERTS_STORED = 16  # training trajectories stored for figures
ROLLOUTS = 8  # current trajectories, from training starts
CURRENT = 0.5  # the fraction of all epochs after which the policy is "the current one" of Figure 2
ALPHAS_BEHIND = tuple(-a / 8 for a in range(8, 0, -1))  # of points behind the current trajectory
ALPHAS_AHEAD = tuple(a / 8 for a in range(8))  # of points on the current trajectory and ahead of it


def landscape_epochs(spec: RunSpec) -> tuple[int, ...]:
    """Return the epochs after which to record a landscape, in ascending order; 0 is the untrained model."""
    count = spec.evaluation.landscapes
    if count is None:
        return ()
    even = (round(spec.epochs * k / count) for k in range(count + 1))
    return tuple(sorted({*even, current_epoch(spec)}))


def current_epoch(spec: RunSpec) -> int:
    """Return the epoch after which the policy is "the current one" of Figure 2."""
    return max(1, round(CURRENT * spec.epochs))


@dataclass(frozen=True)
class RewardInputs:
    """Everything that the reward reads of a group at some time steps (...).

    states: (..., N, D), scaled.
    other_features: (..., N, F - D), the features beside the state (time, start).
    actions: (..., N, A), as the networks read them.
    """

    states: Tensor
    other_features: Tensor
    actions: Tensor

    @classmethod
    def from_trajectories(cls, features: Features, states: Tensor, actions: Tensor) -> "RewardInputs":
        """Take all steps of trajectories: states (B, T + 1, N, D) without the last, and actions (B, T, N, A)."""
        other_features = features(states[:, :-1], states[:, 0])[..., states.shape[-1] :]
        return cls(states[:, :-1], other_features, features.normalize_actions(actions))


def position_gradient(
    learner: AdversarialLearner, at: RewardInputs, agent: int, position: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the agent's reward (...), and its gradient (..., 2) with respect to the agent's own position.

    The agent is at `position` (..., 2), whose leading axes broadcast with those of `at`; by default where it is in
    `at`. Everything else is held fixed. The gradient is in scaled units. Time and memory grow with N for each position.
    """
    position = (at.states[..., agent, :2] if position is None else position).detach().clone().requires_grad_()
    moved = at.states.expand(*position.shape[:-1], *at.states.shape[-2:]).clone()
    moved[..., agent, :2] = position
    read = learner.features.normalize_states(moved)
    own = torch.cat([read[..., agent, :], at.other_features[..., agent, :].expand(*position.shape[:-1], -1)], dim=-1)
    # What the others are read as does not depend on the position, unless positions are relative.
    others = read if learner.features.is_relative else learner.features.normalize_states(at.states)
    x = torch.cat([others, at.other_features.expand(*others.shape[:-1], -1)], dim=-1)
    values = learner.agent_reward(agent, own, x, at.actions.expand(*others.shape[:-1], -1))
    (gradient,) = torch.autograd.grad(values.sum(), position)
    return values.detach(), gradient


class LandscapeRecorder:
    """Computes the landscapes of one run."""

    def __init__(self, context: LearnerContext, learner: AdversarialLearner) -> None:
        self.context, self.learner = context, learner
        experts = context.experts
        chosen = torch.as_tensor(_spread(len(experts), REFERENCES), device=context.device)
        steps = torch.as_tensor(_spread(context.steps, REFERENCE_STATES), device=context.device)
        states = experts.states[chosen]
        all_steps = RewardInputs.from_trajectories(learner.features, states, experts.actions[chosen])
        self.references = RewardInputs(*(part[:, steps].flatten(0, 1) for part in vars(all_steps).values()))  # (K)
        self.agents = states.shape[2]
        everywhere = to_numpy(experts.states[..., :2])  # (B, T + 1, N, 2)
        self.plane = Plane.around(everywhere)
        points, tracks = self.plane.points, [everywhere[:, :, n].reshape(-1, 2) for n in range(self.agents)]
        self.to_expert = np.stack([nearest_points(points, track) - points for track in tracks])
        places = [to_numpy(self.references.states[:, n, :2]) for n in range(self.agents)]
        self.weights = torch.as_tensor(np.stack([closeness(points, place) for place in places]))

    @classmethod
    def for_learner(cls, context: LearnerContext, learner: Learner) -> "LandscapeRecorder | None":
        """Make the recorder of a learner, or return None if no landscape is asked for, or no plane or reward exists."""
        wanted = landscape_epochs(context.spec) and context.experts.actions.shape[-1] == 2
        return cls(context, learner) if wanted and isinstance(learner, AdversarialLearner) else None

    def record(self, epoch: int) -> tuple[dict[str, float], Arrays]:
        """Return the metrics and arrays of the current model, after `epoch` epochs; see docs/database.md.

        Epoch 0 also has what all landscapes share; epoch `current_epoch` also has the vector field of Figure 2.
        """
        made = self.rollouts()
        reward, gradient = self.reward_field()
        prefix = f"landscape/{epoch:04d}"
        arrays = {
            f"{prefix}/reward": _half(reward),
            f"{prefix}/gradient": _half(gradient),
            f"{prefix}/rollouts": _half(self._raw(made)),
        }
        if epoch == 0:
            return {}, {**self._shared_arrays(), **arrays}
        values = {
            "landscape/slope_share": slope_share(reward, gradient, self.plane),
            "landscape/cosine": mean_cosine(gradient, self.to_expert, self.plane.spacing),
        }
        if epoch == current_epoch(self.context.spec):
            more_values, more_arrays = self.vector_field(made)
            values, arrays = values | more_values, arrays | more_arrays
        return values, arrays

    def reward_field(self) -> tuple[np.ndarray, np.ndarray]:
        """Return each agent's reward (N, H, W) over the plane, and its gradient (N, H, W, 2).

        The agent is put on each point of the plane. Everything else comes from the K reference states, whose rewards
        are averaged with weights by the distance between the point and the agent's position there.
        """
        known, (agents, height, width, references) = self.references, self.weights.shape
        points = torch.as_tensor(self.plane.points, dtype=known.states.dtype, device=known.states.device)
        rewards = torch.empty(agents, height, width, dtype=torch.float64)
        gradients = torch.empty(agents, height, width, 2, dtype=torch.float64)
        for agent in range(agents):
            for row in range(height):  # one at a time, for the sake of the processor's cache
                position = points[row].unsqueeze(1).expand(width, references, 2)
                reward, gradient = position_gradient(self.learner, known, agent, position)
                weights = self.weights[agent, row]
                rewards[agent, row] = (weights * reward.double().cpu()).sum(dim=1)
                gradients[agent, row] = (weights.unsqueeze(-1) * gradient.double().cpu()).sum(dim=1)
        return rewards.numpy(), gradients.numpy()

    def rollouts(self) -> Tensor:
        """Sample states (ROLLOUTS, T + 1, N, D) of the current policy from training starts."""
        generator = torch.Generator().manual_seed(self.context.generators.seeds["evaluation"])
        starts = self.context.experts.states[_spread(len(self.context.experts), ROLLOUTS), :1]
        return self.learner.predictor.free_run(starts, self.context.steps, generator)

    def vector_field(self, made: Tensor) -> tuple[dict[str, float], Arrays]:
        """Return the reward's gradient around the rollouts `made` (R, T + 1, N, D): Figure 2.

        The gradient is taken at the states and actions of tau_alpha, between each rollout and the nearest expert
        trajectory. The metrics are its mean cosine with the direction to that expert's position at the same step,
        behind and ahead of the rollouts.
        """
        experts = self.context.experts[nearest(made, self.context.experts.states)]
        alphas = torch.tensor([*ALPHAS_BEHIND, *ALPHAS_AHEAD], device=made.device)
        count, rollouts = len(alphas), len(made)
        each = alphas.repeat_interleave(rollouts)
        states = mix(made.repeat(count, 1, 1, 1), experts.states.repeat(count, 1, 1, 1), each)
        taken = made[:, 1:, :, 2:]  # the environment's actions are the next velocities
        actions = mix(taken.repeat(count, 1, 1, 1), experts.actions.repeat(count, 1, 1, 1), each)
        at = RewardInputs.from_trajectories(self.learner.features, states, actions)
        found = [position_gradient(self.learner, at, agent)[1] for agent in range(self.agents)]
        gradient = to_numpy(torch.stack(found, dim=2)).reshape(count, rollouts, -1, self.agents, 2)
        here = to_numpy(states[:, :-1, :, :2]).reshape(gradient.shape)
        to_expert = to_numpy(experts.states[:, :-1, :, :2]) - here
        behind, ahead = slice(len(ALPHAS_BEHIND)), slice(len(ALPHAS_BEHIND), None)
        values = {
            "landscape/behind_cosine": mean_cosine(gradient[behind], to_expert[behind], self.plane.spacing),
            "landscape/ahead_cosine": mean_cosine(gradient[ahead], to_expert[ahead], self.plane.spacing),
        }
        arrays = {
            "vector_field/alpha": to_numpy(alphas),
            "vector_field/gradient": _half(gradient),
            "vector_field/current": self._raw(made[:, :-1]),
            "vector_field/expert": self._raw(experts.states[:, :-1]),
        }
        return values, arrays

    def _shared_arrays(self) -> Arrays:
        """Return the plane's axes, the length of a scaled unit, and some experts, in raw units."""
        scaling = self.context.integrator.scaling
        axes = {name: scaling.unscale_positions(getattr(self.plane, name)).astype(np.float32) for name in ("x", "y")}
        expert = self._raw(self.context.experts.states[_spread(len(self.context.experts), EXPERTS_STORED)])
        unit = np.array([scaling.position_span / 2])
        return {"landscape/x": axes["x"], "landscape/y": axes["y"], "landscape/unit": unit, "landscape/expert": expert}

    def _raw(self, states: Tensor) -> np.ndarray:
        """Return raw positions (..., 2) of scaled states."""
        raw: np.ndarray = self.context.integrator.scaling.unscale_positions(to_numpy(states[..., :2]))
        return raw.astype(np.float32)


def _spread(length: int, count: int) -> np.ndarray:
    """Return up to `count` indices, evenly spaced from 0 to length - 1."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(int)


def _half(values: np.ndarray) -> np.ndarray:
    """Convert to float16 for figures. Finite values stay finite."""
    largest = np.finfo(np.float16).max
    finite = np.isfinite(values)
    return np.where(finite, np.clip(values, -largest, largest), values).astype(np.float16)
