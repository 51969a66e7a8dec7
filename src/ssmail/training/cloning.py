"""bc in training (section 2): the policy of the adversarial methods, fitted to the expert's actions step by step."""

from typing import Any

import torch
from torch import nn

from ssmail.config.sections import required
from ssmail.models.features import Features
from ssmail.models.normalization import ActionBounds
from ssmail.models.policy import GraphPolicy
from ssmail.training.learning import Setting
from ssmail.training.learning_rates import DecayingRates
from ssmail.training.policy_predictor import PolicyPredictor
from ssmail.training.updates import clipped_step, mean_of, with_noise


class CloningLearner:
    """Maximum likelihood on batches of whole expert trajectories. Nothing is generated, so no curriculum applies."""

    def __init__(self, setting: Setting) -> None:
        spec = setting.spec
        model = required(spec.model)
        self.setting, self.cloning, self.training = setting, required(spec.cloning), required(spec.training)
        self.generators, self.device = setting.generators, setting.device
        state_size, action_size = setting.experts.states.shape[-1], setting.experts.actions.shape[-1]
        features = Features.of(model, setting.experts.states)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            policy = GraphPolicy(
                features.size(state_size), action_size, model, ActionBounds.of(model, features.normalization)
            )
        self.policy = policy.to(self.device)
        self.predictor = PolicyPredictor(self.policy, features, setting.integrator)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=self.cloning.learning_rate, fused=True)
        self.rates = DecayingRates(
            self.training, {"policy": self.optimizer}, {"policy": self.cloning.learning_rate_final}
        )

    def networks(self) -> list[nn.Module]:
        """The policy."""
        return [self.policy]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """training.updates gradient steps."""
        self.rates.set(epoch)
        return mean_of([self._update() for _ in range(self.training.updates)])

    def _update(self) -> dict[str, float]:
        batch = self.setting.experts.draw(self.training.batch, self.generators["data"])
        read = with_noise(batch.states[:, :-1], self.cloning.input_noise, self.generators["data"])
        b, t, n, _ = read.shape
        x = self.predictor.features(read, batch.states[:, 0])
        graph_noise = self.policy.draw_graph_noise(b, t, n, self.generators["policy"]).to(self.device)
        graphs, _, _ = self.policy.graphs(x, graph_noise)
        velocity = read[..., self.policy.action_size :]
        loss = -self.policy.actor.log_prob(x, graphs, velocity, batch.actions).mean()
        clipped_step(self.optimizer, loss, self.policy.parameters(), self.training.gradient_clip)
        return {"cloning/loss": float(loss.detach())}

    def state_dict(self) -> dict[str, Any]:
        """Weights and optimiser."""
        return {"policy": self.policy.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])
