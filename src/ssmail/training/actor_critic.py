"""G-SAC (section 3.2.2): a graph policy, twin critics with target networks, a temperature, and their joint update."""

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssmail.config.sections import SacSpec
from ssmail.losses.soft_actor_critic import actor_loss, critic_loss, critic_target, temperature_loss
from ssmail.models.critic import TwinCritic
from ssmail.models.graph_encoder import graph_entropy
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import entries, fitted, load_part
from ssmail.training.optimization import clipped_step
from ssmail.training.rollout import PolicyPredictor
from ssmail.training.seeding import Generators

Reward = Callable[[Tensor, Tensor], Tensor]  # features (B, T, N, F), actions as read (B, T, N, A) -> rewards (B, T, N)


@dataclass(frozen=True)
class Transitions:
    """A training batch of actor and critics: C time steps from each of B trajectories."""

    x: Tensor  # (B, C, N, F)
    actions: Tensor  # (B, C, N, A), as the networks read them
    graph: Tensor  # (B, C, N, N, K), with gradient
    velocity: Tensor  # (B, C, N, A) before the action
    next_x: Tensor
    next_graph: Tensor  # detached
    next_velocity: Tensor
    edge_entropy: Tensor  # nats, mean over all steps


class ActorCritic:
    """Policy, critics and temperature with their optimizers, whose learning rates the caller sets.

    `gradient_clip` bounds the norm of each network's gradient.
    """

    def __init__(
        self, spec: SacSpec, actor: PolicyPredictor, critic: TwinCritic, generators: Generators, gradient_clip: float
    ) -> None:
        self.spec, self.gradient_clip = spec, gradient_clip
        self.policy, self.critic = actor.model, critic
        self.features, self.integrator, self.generators = actor.features, actor.integrator, generators
        self.device = next(critic.parameters()).device
        self.target_critic = deepcopy(critic).requires_grad_(False)
        self.log_temperature = torch.tensor(max(spec.temperature, 1e-8), device=self.device).log().requires_grad_()
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "actor": torch.optim.Adam(self.policy.parameters(), lr=spec.actor_learning_rate, fused=True),
            "critic": torch.optim.Adam(critic.parameters(), lr=spec.critic_learning_rate, fused=True),
            "temperature": torch.optim.Adam([self.log_temperature], lr=spec.temperature_learning_rate, fused=True),
        }
        self.final_rates = {
            "actor": spec.actor_learning_rate_final,
            "critic": spec.critic_learning_rate_final,
            "temperature": spec.actor_learning_rate_final,
        }

    @property
    def temperature(self) -> Tensor:
        """The entropy's weight, detached."""
        fixed = torch.tensor(self.spec.temperature, device=self.device)
        return self.log_temperature.detach().exp() if self.spec.automatic_temperature else fixed

    def update(
        self, batch: Batch, chosen: Callable[[int], Tensor], reward: Reward, *, actor_learns: bool = True
    ) -> dict[str, Tensor]:
        """Take one SAC step on whole trajectories; `chosen` draws which of their T time steps to use.

        Rewards are recomputed from the stored states and actions. Without `actor_learns` the policy and its temperature
        stay fixed while the critics learn the policy's value. Returns losses and means as scalar tensors.
        """
        at = self._transitions(batch, chosen)
        # Critics: one regression step to r + gamma * (min target Q - temperature * log pi) of the next state.
        with torch.no_grad():
            rewards = reward(at.x, at.actions)
            next_action, next_log_prob = self.policy.actor.sample_with_log_prob(
                at.next_x, at.next_graph, at.next_velocity, self._noise(at.actions)
            )
            next_action = self.features.normalize_actions(next_action)
            next_q = self.target_critic(at.next_x, next_action, at.next_graph)
            target = critic_target(rewards, next_q, next_log_prob, self.temperature, self.spec.gamma)
        value_loss = critic_loss(self.critic(at.x, at.actions, at.graph.detach()), target)
        self._step("critic", value_loss, self.critic.parameters())
        # Actor and temperature.
        policy_loss, log_prob = self._update_actor(at, actor_learns)
        # Target networks.
        self._update_target()
        return {
            "critic/loss": value_loss,
            "actor/loss": policy_loss,
            "temperature": self.temperature,
            "entropy": -log_prob.mean(),
            "graph/entropy": at.edge_entropy,
            "reward": rewards.mean(),
        }

    def _transitions(self, batch: Batch, chosen: Callable[[int], Tensor]) -> Transitions:
        """Infer the graphs of whole trajectories, then pick time steps."""
        a = batch.actions.shape[-1]
        states = batch.states[:, :-1]
        next_states = self.integrator.step(states, batch.actions)
        x = self.features(states, batch.states[:, 0])
        next_x = self.features(next_states, batch.states[:, 0], first_step=1)
        # One pass of the encoder over all T + 1 states gives the graphs at both ends of every transition.
        history = torch.cat([x, next_x[:, -1:]], dim=1)
        graphs, edge_entropy = self._graphs(history)
        at = chosen(x.shape[1])
        return Transitions(
            x=x[:, at],
            actions=self.features.normalize_actions(batch.actions[:, at]),
            graph=graphs[:, at],
            velocity=states[:, at, :, a:],
            next_x=next_x[:, at],
            next_graph=graphs[:, at + 1].detach(),
            next_velocity=next_states[:, at, :, a:],
            edge_entropy=edge_entropy,
        )

    def _graphs(self, history: Tensor) -> tuple[Tensor, Tensor]:
        """Sample graphs (B, T, N, N, K) from features (B, T, N, F), and return them with their entropy in nats.

        Truncated backpropagation through time: with sac.encoder_steps, the gradient flows through a random window of
        that many consecutive steps only. The values do not depend on the window.
        """
        b, t, n, _ = history.shape
        noise = (
            self.policy.draw_graph_noise(b, t, n, self.generators["policy"]).to(self.device).expand(b, t, -1, -1, -1)
        )
        learned = min(self.spec.encoder_steps or t, t)
        start = int(torch.randint(t - learned + 1, (), generator=self.generators["data"])) if learned < t else 0
        # Read the steps before, in and after the window in turn; only the window records a gradient.
        graphs, logits, memory = [], [], None
        for first, last in ((0, start), (start, start + learned), (start + learned, t)):
            if first < last:
                with torch.set_grad_enabled(first == start):
                    graph, logit, memory = self.policy.graphs(history[:, first:last], noise[:, first:last], memory)
                graphs.append(graph)
                logits.append(logit)
        return torch.cat(graphs, dim=1), graph_entropy(torch.cat(logits, dim=1))

    def _update_actor(self, at: Transitions, learns: bool) -> tuple[Tensor, Tensor]:
        """Take one step of actor and graph encoder, then one of the temperature; return the loss and log pi."""
        action, log_prob = self.policy.actor.sample_with_log_prob(at.x, at.graph, at.velocity, self._noise(at.actions))
        action = self.features.normalize_actions(action)
        self.critic.requires_grad_(False)  # the actor's gradient flows through the critics but not into them
        loss = actor_loss(self.critic(at.x, action, at.graph.detach()), log_prob, self.temperature)
        self.critic.requires_grad_(True)
        if learns:
            self._step("actor", loss - self.spec.graph_entropy * at.edge_entropy, self.policy.parameters())
        if learns and self.spec.automatic_temperature:
            target_entropy = self.spec.target_entropy * at.actions.shape[-1]
            self._step(
                "temperature", temperature_loss(self.log_temperature, log_prob, target_entropy), [self.log_temperature]
            )
        return loss, log_prob

    def _noise(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generators["policy"]).to(self.device)

    def _step(self, name: str, loss: Tensor, parameters: Iterable[Tensor]) -> None:
        clipped_step(self.optimizers[name], loss, parameters, self.gradient_clip)

    @torch.no_grad()
    def _update_target(self) -> None:
        """Move the target networks towards the critics by Polyak averaging: target += polyak * (critic - target)."""
        target: list[Tensor] = list(self.target_critic.parameters())
        source: list[Tensor] = list(self.critic.parameters())
        torch._foreach_lerp_(target, source, self.spec.polyak)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that an update changes."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "log_temperature": self.log_temperature.detach().clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`. Raises UnfitState when it is the state of other networks."""
        own = self.state_dict()
        state = entries(state, own, "learner.actor_critic")
        optimizers = entries(state["optimizers"], self.optimizers, "learner.actor_critic.optimizers")
        for name in ("policy", "critic", "target_critic"):
            load_part(getattr(self, name), state[name], f"learner.actor_critic.{name}")
        for name, optimizer in self.optimizers.items():
            load_part(optimizer, optimizers[name], f"learner.actor_critic.optimizers.{name}")
        with torch.no_grad():
            where = "learner.actor_critic.log_temperature"
            self.log_temperature.copy_(fitted(state["log_temperature"], own["log_temperature"], where))
