"""Generating trajectories: the policy and the environment, step by step."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.models.graph_encoder import Memory
from ssmail.models.policy import GraphPolicy


@dataclass(frozen=True)
class Rollout:
    """Generated trajectories, scaled.

    states: (B, T + 1, N, D), the states that the policy read, and the one it ended in.
    actions: (B, T, N, A), taken in states[:, :T].
    """

    states: Tensor
    actions: Tensor


@torch.no_grad()
def rollout(
    policy: GraphPolicy,
    features: Features,
    integrator: Integrator,
    start: Tensor,
    steps: int,
    generator: torch.Generator,
    *,
    expert: Tensor | None = None,
    interventions: Tensor | None = None,
    deterministic: bool = False,
) -> Rollout:
    """Roll the policy out for `steps` actions from `start` (B, N, D).

    Where `interventions` (B, T) is set, the group is put on the state of `expert` (B, T, N, D) before it acts.
    `deterministic` takes the mean action; the graph is sampled all the same.
    """
    b, n, _ = start.shape
    graph_noise = policy.draw_graph_noise(b, steps, n, generator).to(start.device)
    noise = torch.randn(steps, b, 1, n, policy.action_size, generator=generator).to(start.device)
    if deterministic:
        noise = torch.zeros_like(noise)
    state = start.unsqueeze(1)
    memory: Memory | None = None
    states, actions = [], []
    for t in range(steps):
        if interventions is not None and expert is not None:
            state = torch.where(interventions[:, t].view(b, 1, 1, 1), expert[:, t : t + 1], state)
        x = features(state, start, t)
        at = t if graph_noise.shape[1] > 1 else 0
        graph, _, memory = policy.graphs(x, graph_noise[:, at : at + 1], memory)
        action = policy.actor.sample(x, graph, state[..., policy.action_size :], noise[t])
        states.append(state)
        actions.append(action)
        state = integrator.step(state, action)
    return Rollout(torch.cat([*states, state], dim=1), torch.cat(actions, dim=1))
