"""Generating trajectories: the policy and the environment, step by step."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.models.graph_encoder import Memory
from ssmail.models.policy import GraphPolicy

READ_AT_ONCE = 10  # observed steps: with the edges of recorded motion all of them together are gigabytes


@dataclass(frozen=True)
class Rollout:
    """Generated trajectories, scaled.

    states: (B, T + 1, N, D), the last observed state and those that followed.
    actions: (B, T, N, A), taken in states[:, :T].
    """

    states: Tensor
    actions: Tensor


@torch.no_grad()
def rollout(
    policy: GraphPolicy,
    features: Features,
    integrator: Integrator,
    observed: Tensor,
    steps: int,
    generator: torch.Generator,
    *,
    expert: Tensor | None = None,
    interventions: Tensor | None = None,
    deterministic: bool = False,
    noise: Tensor | None = None,
) -> Rollout:
    """Roll the policy out for `steps` actions from the last of the states `observed` (B, H, N, D); the graph encoder
    has read the others.

    Where `interventions` (B, T) is set, the group is put on the state of `expert` (B, T, N, D) before it acts.
    `deterministic` takes the mean action; the graph is sampled all the same. `noise` (B, H + T - 1, N, D) is added to
    every state that the policy reads, not to where the group is.
    """
    b, h, n, _ = observed.shape
    graph_noise = policy.draw_graph_noise(b, steps, n, generator).to(observed.device)
    action_noise = torch.randn(steps, b, 1, n, policy.action_size, generator=generator).to(observed.device)
    if deterministic:
        action_noise = torch.zeros_like(action_noise)
    if noise is None:
        noise = observed.new_zeros(1, h + steps - 1, 1, 1)
    start = observed[:, 0] + noise[:, 0]
    memory: Memory | None = None
    for first in range(0, h - 1, READ_AT_ONCE):
        part = slice(first, min(first + READ_AT_ONCE, h - 1))
        _, memory = policy.encoder(features(observed[:, part] + noise[:, part], start, first), memory)
    state = observed[:, -1:]
    states, actions = [], []
    for t in range(steps):
        if interventions is not None and expert is not None:
            state = torch.where(interventions[:, t].view(b, 1, 1, 1), expert[:, t : t + 1], state)
        read = state + noise[:, h - 1 + t : h + t]
        x = features(read, start, h - 1 + t)
        at = t if graph_noise.shape[1] > 1 else 0
        graph, _, memory = policy.graphs(x, graph_noise[:, at : at + 1], memory)
        action = policy.actor.sample(x, graph, read[..., policy.action_size :], action_noise[t])
        states.append(state)
        actions.append(action)
        state = integrator.step(state, action)
    return Rollout(torch.cat([*states, state], dim=1), torch.cat(actions, dim=1))
