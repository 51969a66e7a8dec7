"""Rollouts of a graph policy in the trajectory environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import torch
from torch import Tensor

from ssmail.config.sections import ModelSpec
from ssmail.envs.integrator import Integrator
from ssmail.models import message_passing
from ssmail.models.features import Features
from ssmail.models.graph_encoder import Memory
from ssmail.models.graph_steps import GraphSteps
from ssmail.models.normalization import ActionBounds
from ssmail.models.policy import GraphPolicy
from ssmail.training.batches import Batch
from ssmail.training.learner import Reading
from ssmail.training.seeding import Source, drawn

ENCODER_CHUNK = 10  # observed steps read at once; on recorded motion the edges of all steps together take gigabytes


@dataclass(frozen=True)
class Rollout:
    """Generated trajectories, scaled.

    states: (B, T + 1, N, D), the last observed state and those that followed.
    actions: (B, T, N, A), taken in states[:, :T].
    """

    states: Tensor
    actions: Tensor


@dataclass(frozen=True)
class PolicyPredictor:
    """A graph policy in its environment: rollouts for training, and the Predictor interface for evaluation.

    The graphs are sampled in every case.
    """

    model: GraphPolicy
    features: Features
    integrator: Integrator

    @classmethod
    def create(cls, spec: ModelSpec, by_number: Sequence[Batch], integrator: Integrator) -> "PolicyPredictor":
        """Make a policy with initial weights from torch's global generator, sized and normalized for the experts.

        by_number: the training split, for each number of agents.
        """
        states = by_number[0].states
        features = Features.of(spec, *(batch.states for batch in by_number))
        made = cls.untrained(spec, features, action_bounds(spec, features, by_number), states.shape[-1], integrator)
        made.model.to(states.device)
        return made

    @classmethod
    def untrained(
        cls, spec: ModelSpec, features: Features, bounds: ActionBounds, state_size: int, integrator: Integrator
    ) -> "PolicyPredictor":
        """Make a policy with initial weights from torch's global generator that reads these features."""
        policy = GraphPolicy(features.size(state_size), state_size // 2, spec, bounds)
        return cls(policy, features, integrator)

    @torch.no_grad()
    def rollout(
        self,
        observed: Tensor,
        steps: int,
        generator: Source,
        *,
        expert: Tensor | None = None,
        interventions: Tensor | None = None,
        deterministic: bool = False,
        noise: Tensor | None = None,
        samples: int = 1,
    ) -> Rollout:
        """Roll the policy out for `steps` actions from the last of the `observed` states (B, H, N, D).

        The graph encoder reads the earlier observed states first. At steps where `interventions` (B, T) is set, the
        group is moved to the state of `expert` (B, T, N, D) before it acts. `deterministic` takes the mean action; the
        graph is sampled in any case. `noise` (B, H + T - 1, N, D) is added to every state that the policy reads; the
        environment's state stays clean. With the weights of S seeds, all of this has another axis S in front, and
        there is one generator per seed.

        With several `samples` of each group the rollout has samples * B trajectories: the first sample of every group,
        then the second, and so on. The policy reads each group's observed states once, and GraphSteps infers the graphs
        of the following steps.
        """
        policy, (*lead, h, n, _) = self.model, observed.shape
        groups, a = lead[-1], policy.action_size
        b = groups * samples
        # Draw all noise up front.
        graph_noise = drawn(generator, lambda g: policy.draw_graph_noise(b, steps, n, g)).to(observed.device)
        action_noise = drawn(generator, lambda g: torch.randn(steps, b, 1, n, a, generator=g)).to(observed.device)
        action_noise = action_noise.movedim(-5, 0)  # (T, B, 1, N, A)
        if deterministic:
            action_noise = torch.zeros_like(action_noise)
        if noise is None:
            noise = observed.new_zeros(1, h + steps - 1, 1, 1)
        start = observed[..., 0, :, :] + noise[..., 0, :, :]
        # Warm up the encoder's memory on the observed history.
        memory: Memory | None = None
        for first in range(0, h - 1, ENCODER_CHUNK):
            part = slice(first, min(first + ENCODER_CHUNK, h - 1))
            read = observed[..., part, :, :] + noise[..., part, :, :]
            _, memory = policy.encoder(self.features(read, start, first), memory)
        state = observed[..., -1:, :, :]
        graph_steps = None
        if samples > 1:
            state, start = state.repeat(samples, 1, 1, 1), start.repeat(samples, 1, 1)
            memory = memory and (memory[0].repeat(1, samples, 1), memory[1].repeat(1, samples, 1))
            graph_steps = GraphSteps(policy.encoder, memory, b, n) if message_passing.FAST else None
        states, actions = [], []
        for t in range(steps):
            # Curriculum: put the group back on the expert's track.
            if interventions is not None and expert is not None:
                state = torch.where(interventions[..., t].view(*lead, 1, 1, 1), expert[..., t : t + 1, :, :], state)
            # Policy: read the state, infer the graph, act.
            read = state + noise[..., h - 1 + t : h + t, :, :]
            x = self.features(read, start, h - 1 + t)
            at = t if graph_noise.shape[-4] > 1 else 0
            noise_of_graph = graph_noise[..., at : at + 1, :, :, :]
            if graph_steps is None:
                graph, _, memory = policy.graphs(x, noise_of_graph, memory)
            else:
                graph = graph_steps.sample(x, noise_of_graph)
            action = policy.actor.sample(x, graph, read[..., a:], action_noise[t])
            states.append(state)
            actions.append(action)
            # Environment.
            state = self.integrator.step(state, action)
        return Rollout(torch.cat([*states, state], dim=-3), torch.cat(actions, dim=-3))

    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: Unpack[Reading]) -> Tensor:
        """See Predictor."""
        return self.rollout(observed, steps, generator, **reading).states

    @torch.no_grad()
    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor."""
        now = states[:, :-1]
        b, t, n, _ = now.shape
        x = self.features(now, states[:, 0])
        noise = self.model.draw_graph_noise(b, t, n, generator).to(now.device)
        graphs, _, _ = self.model.graphs(x, noise)
        a = self.model.action_size
        no_noise = torch.zeros(b, t, n, a, device=now.device)
        return self.integrator.step(now, self.model.actor.sample(x, graphs, now[..., a:], no_noise))


def action_bounds(spec: ModelSpec, features: Features, by_number: Sequence[Batch]) -> ActionBounds:
    """Return the bounds of a policy's actions, from the training split for each number of agents."""
    velocities = [batch.states[..., batch.actions.shape[-1] :] for batch in by_number]
    return ActionBounds.of(spec, features.normalization, velocities)
