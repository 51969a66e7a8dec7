"""A PettingZoo world of the tests: agents accelerate in the square [-1, 1]², and its walls throw them back."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv


class BouncingBox(ParallelEnv):
    """Observations are [velocity, position]; an action is an acceleration.

    The first agent may leave at a step, and the last one may join at a step.
    """

    metadata = {"name": "bouncing_box_v0"}  # noqa: RUF012 - as PettingZoo has it

    def __init__(self, count: int = 3, steps: int = 30, leaves: int | None = None, joins: int | None = None) -> None:
        self.possible_agents = [f"ball_{n}" for n in range(count)]
        self.steps, self.leaves, self.joins = steps, leaves, joins
        self.spaces = {agent: Box(-np.inf, np.inf, (4,)) for agent in self.possible_agents}
        self.actions = {agent: Box(-0.1, 0.1, (2,)) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> Box:
        return self.spaces[agent]

    def action_space(self, agent: str) -> Box:
        return self.actions[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        draw = np.random.default_rng(seed)
        self.agents, self.at = self.possible_agents[: None if self.joins is None else -1], 0
        self.velocity, self.position = draw.uniform(-0.1, 0.1, (2, len(self.possible_agents), 2))
        return self._observed(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        acting = self.agents
        for n, agent in enumerate(self.possible_agents):
            if agent in acting:
                self.velocity[n] += actions[agent]
        moved = self.position + self.velocity
        outside = np.abs(moved) > 1
        self.velocity[outside] *= -1
        self.position = np.where(outside, np.sign(moved) * 2 - moved, moved)
        self.at += 1
        over = {agent: self.at >= self.steps or (n == 0 and self.at == self.leaves) for n, agent in enumerate(acting)}
        if self.at == self.joins:
            self.agents, over = list(self.possible_agents), over | {self.possible_agents[-1]: False}
            acting = self.agents
        observed = self._observed()
        self.agents = [agent for agent in acting if not over[agent]]
        return observed, dict.fromkeys(acting, 0.0), dict.fromkeys(acting, False), over, {agent: {} for agent in acting}

    def _observed(self) -> dict[str, np.ndarray]:
        states = np.concatenate([self.velocity, self.position], axis=-1)
        return {agent: states[n] for n, agent in enumerate(self.possible_agents) if agent in self.agents}
