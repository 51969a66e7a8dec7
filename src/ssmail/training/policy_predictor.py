"""A graph policy as a predictor."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.models.policy import GraphPolicy
from ssmail.training.rollout import rollout


@dataclass(frozen=True)
class PolicyPredictor:
    """The policy acts and the environment answers."""

    policy: GraphPolicy
    features: Features
    integrator: Integrator

    def free_run(
        self,
        observed: Tensor,
        steps: int,
        generator: torch.Generator,
        *,
        deterministic: bool = False,
        noise: Tensor | None = None,
    ) -> Tensor:
        """See Predictor. Actions are sampled, or their means; the graph is sampled in both cases."""
        made = rollout(
            self.policy,
            self.features,
            self.integrator,
            observed,
            steps,
            generator,
            deterministic=deterministic,
            noise=noise,
        )
        return made.states

    @torch.no_grad()
    def one_step(self, states: Tensor, generator: torch.Generator) -> Tensor:
        """See Predictor. The mean action, under a sampled graph."""
        now = states[:, :-1]
        b, t, n, _ = now.shape
        x = self.features(now, states[:, 0])
        noise = self.policy.draw_graph_noise(b, t, n, generator).to(now.device)
        graphs, _, _ = self.policy.graphs(x, noise)
        a = self.policy.action_size
        still = torch.zeros(b, t, n, a, device=now.device)
        return self.integrator.step(now, self.policy.actor.sample(x, graphs, now[..., a:], still))

    def state_dict(self) -> dict[str, Any]:
        """The policy's weights."""
        return self.policy.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> object:
        """Inverse of `state_dict`."""
        return self.policy.load_state_dict(state)
