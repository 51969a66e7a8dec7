"""Supervised learning from expert trajectories; behavioral cloning (bc, section 2)."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ssmail.config.sections import required
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import Stateful
from ssmail.training.learner import LearnerContext
from ssmail.training.optimization import LearningRateSchedule, add_noise, clipped_step, mean_metrics
from ssmail.training.rollout import PolicyPredictor


class SupervisedLearner:
    """The part that bc, nri and dnri share: one network, Adam, and a learning-rate schedule.

    `name` is the network's name in checkpoints.
    """

    def __init__(self, context: LearnerContext, name: str, network: nn.Module) -> None:
        self.context, self.generators, self.device = context, context.generators, context.device
        self.cloning, self.training = required(context.spec.cloning), required(context.spec.training)
        self.name, self.network = name, network
        self.optimizer = torch.optim.Adam(network.parameters(), lr=self.cloning.learning_rate, fused=True)
        self.schedule = LearningRateSchedule(
            self.training, {name: self.optimizer}, {name: self.cloning.learning_rate_final}
        )

    def networks(self) -> list[nn.Module]:
        """Return the network."""
        return [self.network]

    def step(self, loss: Tensor) -> None:
        """Take one optimizer step on `loss`."""
        clipped_step(self.optimizer, loss, self.network.parameters(), self.training.gradient_clip)

    def parts(self) -> Mapping[str, Stateful]:
        """Return network and optimizer."""
        return {self.name: self.network, "optimizer": self.optimizer}


class CloningLearner(SupervisedLearner):
    """Fits the policy of the adversarial methods to the expert's actions by maximum likelihood.

    It generates nothing, so no curriculum applies.
    """

    def __init__(self, context: LearnerContext) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(context.generators.seeds["weights"])
            self.predictor = PolicyPredictor.create(required(context.spec.model), context.by_number, context.integrator)
        self.policy = self.predictor.model
        super().__init__(context, "policy", self.policy)

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Take training.updates gradient steps."""
        self.schedule.set(epoch)
        turns = self.context.turns(epoch, self.training.updates)
        return mean_metrics([self._update(self.context.by_number[turn]) for turn in turns])

    def _update(self, experts: Batch) -> dict[str, float]:
        batch = experts.draw(self.training.batch, self.generators["data"])
        read = add_noise(batch.states[:, :-1], self.cloning.input_noise, self.generators["data"])
        b, t, n, _ = read.shape
        x = self.predictor.features(read, batch.states[:, 0])
        graph_noise = self.policy.draw_graph_noise(b, t, n, self.generators["policy"]).to(self.device)
        graphs, _, _ = self.policy.graphs(x, graph_noise)
        velocity = read[..., self.policy.action_size :]
        loss = -self.policy.actor.log_prob(x, graphs, velocity, batch.actions).mean()
        self.step(loss)
        return {"cloning/loss": float(loss.detach())}
