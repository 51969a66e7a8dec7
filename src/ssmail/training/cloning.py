"""Behavioral cloning (bc, section 2): the policy of the adversarial methods, fitted to the expert's actions."""

from collections.abc import Mapping

import torch
from torch import nn

from ssmail.config.sections import required
from ssmail.models.features import Features
from ssmail.models.normalization import ActionBounds
from ssmail.models.policy import GraphPolicy
from ssmail.training.learner import LearnerContext, Stateful
from ssmail.training.optimization import LearningRateSchedule, add_noise, clipped_step, mean_metrics
from ssmail.training.rollout import PolicyPredictor


class CloningLearner:
    """Maximum likelihood on batches of whole expert trajectories. It generates nothing, so no curriculum applies."""

    def __init__(self, context: LearnerContext) -> None:
        spec = context.spec
        model = required(spec.model)
        self.context, self.cloning, self.training = context, required(spec.cloning), required(spec.training)
        self.generators, self.device = context.generators, context.device
        state_size, action_size = context.experts.states.shape[-1], context.experts.actions.shape[-1]
        features = Features.of(model, context.experts.states)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            policy = GraphPolicy(
                features.size(state_size), action_size, model, ActionBounds.of(model, features.normalization)
            )
        self.policy = policy.to(self.device)
        self.predictor = PolicyPredictor(self.policy, features, context.integrator)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=self.cloning.learning_rate, fused=True)
        self.schedule = LearningRateSchedule(
            self.training, {"policy": self.optimizer}, {"policy": self.cloning.learning_rate_final}
        )

    def networks(self) -> list[nn.Module]:
        """Return the policy."""
        return [self.policy]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Take training.updates gradient steps."""
        self.schedule.set(epoch)
        return mean_metrics([self._update() for _ in range(self.training.updates)])

    def _update(self) -> dict[str, float]:
        batch = self.context.experts.draw(self.training.batch, self.generators["data"])
        read = add_noise(batch.states[:, :-1], self.cloning.input_noise, self.generators["data"])
        b, t, n, _ = read.shape
        x = self.predictor.features(read, batch.states[:, 0])
        graph_noise = self.policy.draw_graph_noise(b, t, n, self.generators["policy"]).to(self.device)
        graphs, _, _ = self.policy.graphs(x, graph_noise)
        velocity = read[..., self.policy.action_size :]
        loss = -self.policy.actor.log_prob(x, graphs, velocity, batch.actions).mean()
        clipped_step(self.optimizer, loss, self.policy.parameters(), self.training.gradient_clip)
        return {"cloning/loss": float(loss.detach())}

    def parts(self) -> Mapping[str, Stateful]:
        """Return policy and optimizer."""
        return {"policy": self.policy, "optimizer": self.optimizer}
