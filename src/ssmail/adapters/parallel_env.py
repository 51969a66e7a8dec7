"""The trajectory environment of an expert set, for PettingZoo: agents that move by velocities.

Importing this module raises InputError if PettingZoo or Gymnasium is not installed.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import SPLITS, ExpertSet, Floats
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError, missing_package, unknown_name

try:
    from gymnasium.spaces import Box
    from pettingzoo import ParallelEnv
except ModuleNotFoundError as error:
    raise missing_package(error, "adapters") from None

Reward = Callable[[Floats, Floats, Floats], Floats]
"""From the states (N, 2P), the actions (N, P) and the next states (N, 2P) to the rewards (N,), all in raw units."""

RAW = Integrator(Scaling(-1.0, 1.0, -1.0, 1.0))  # a scaling that changes nothing
ROOM = 0.5  # of the range of the expert's velocities, that the action space leaves free at either end


class TrajectoryEnv(ParallelEnv):  # type: ignore[misc]
    """N agents that start as the expert does in a window of a split; an action is the next velocity, in raw units.

    An episode starts from the last of the `observed` states of a window and ends with the window, by truncation. Which
    window is drawn uniformly at `reset`, or chosen by its `options`, as {"window": 3}; `infos` name it. The agents are
    agent_0 to agent_(N-1). Of a set with windows of different numbers of agents, N is the largest number, and a window
    has the first of them.

    Observations: (N * 2P,), the agent's own [position, velocity], then those of the others in their order; zeros for
    agents that the window lacks. `state()`: (N * 2P,), those of all agents in their order.
    Actions: (P,). `step` takes any velocity; the bounds of the action space, which samplers and some learners need,
    leave half of the range of the training velocities free at either end.
    Rewards: those of `reward`, otherwise 0.

    trajectories: the windows of the split.

    Raises InputError for a split that does not exist, and if `observed` leaves no step of a window.
    """

    def __init__(
        self, experts: ExpertSet, split: str = "train", *, observed: int = 1, reward: Reward | None = None
    ) -> None:
        if split not in SPLITS:
            raise unknown_name("split", split, SPLITS)
        self.trajectories = getattr(experts, split)
        _, self._states, count, self._axes = self.trajectories.positions.shape
        if not 1 <= observed < self._states:
            raise InputError(
                f"{observed} observed states leave no step of windows of {self._states}; observe 1 to "
                f"{self._states - 1}"
            )
        self._observed, self._reward = observed, reward
        self.metadata: dict[str, Any] = {"name": f"ssmail_{experts.environment}_v0", "render_modes": []}
        self.render_mode = None
        self.possible_agents = [f"agent_{n}" for n in range(count)]
        self.agents: list[str] = []
        scaling = experts.scaling
        room = ROOM * scaling.velocity_span
        low, high = scaling.velocity_min - room, scaling.velocity_max + room
        joint, own = (count * 2 * self._axes,), (self._axes,)
        self.state_space = Box(-np.inf, np.inf, joint, np.float64)
        self.observation_spaces = {a: Box(-np.inf, np.inf, joint, np.float64) for a in self.possible_agents}
        self.action_spaces = {a: Box(low, high, own, np.float64) for a in self.possible_agents}
        self._random = np.random.default_rng()
        self._now, self._seen = np.zeros((count, 2 * self._axes)), observed  # the current states; how many so far

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Floats], dict[str, dict[str, Any]]]:
        """Begin an episode. A `seed` starts the draws of windows anew.

        Raises InputError if `options` name a window that the split does not have.
        """
        if seed is not None:
            self._random = np.random.default_rng(seed)
        windows = len(self.trajectories)
        window = (options or {}).get("window")
        if window is None:
            window = int(self._random.integers(windows))
        elif window not in range(windows):
            raise InputError(f"there is no window {window!r:.40}; the split has the windows 0 to {windows - 1}")
        present = len(self.possible_agents) if self.trajectories.agents is None else self.trajectories.agents[window]
        self.agents = self.possible_agents[:present]
        motion = (self.trajectories.positions, self.trajectories.velocities)
        self._now = np.concatenate([array[window, self._observed - 1] for array in motion], axis=-1)
        self._seen = self._observed
        return self._observations(), {agent: {"window": window} for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Floats], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move all agents by their actions. After the end of an episode there are no agents, and nothing moves."""
        agents = self.agents
        taken = np.zeros((len(self.possible_agents), self._axes))
        for row, agent in enumerate(agents):
            taken[row] = actions[agent]
        before, moving = self._now, slice(len(agents))
        self._now = RAW.step(torch.from_numpy(before), torch.from_numpy(taken)).numpy()
        rewards = np.zeros(len(agents))
        if self._reward is not None and agents:
            rewards = self._reward(before[moving], taken[moving], self._now[moving])
        self._seen += 1
        over = self._seen >= self._states
        observations = self._observations()
        if over:
            self.agents = []
        return (
            observations,
            dict(zip(agents, map(float, rewards), strict=True)),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: {} for agent in agents},
        )

    def state(self) -> Floats:
        """Return the states of all agents, (N * 2P,)."""
        joint: Floats = self._now.ravel()
        return joint.copy()

    def _observations(self) -> dict[str, Floats]:
        rows = np.arange(len(self.possible_agents))
        return {
            agent: self._now[np.argsort(rows != row, kind="stable")].ravel() for row, agent in enumerate(self.agents)
        }
