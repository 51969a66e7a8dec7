"""G-SAC in training (section 3.2.2): the policy, twin critics, their slow copies, the temperature, and one update."""

from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssmail.config.sections import SacSpec
from ssmail.envs.integrator import Integrator
from ssmail.losses.soft_actor_critic import actor_loss, critic_loss, critic_target, temperature_loss
from ssmail.models.critic import TwinCritic
from ssmail.models.features import Features
from ssmail.models.graph_encoder import graph_entropy
from ssmail.models.policy import GraphPolicy
from ssmail.training.replay import Batch
from ssmail.training.seeding import Generators
from ssmail.training.updates import clipped_step

Reward = Callable[[Tensor, Tensor], Tensor]  # features (B, T, N, F), actions as read (B, T, N, A) -> rewards (B, T, N)


@dataclass(frozen=True)
class Transitions:
    """Some time steps of some trajectories: what actor and critics learn from. C steps are chosen of each."""

    x: Tensor  # (B, C, N, F)
    actions: Tensor  # (B, C, N, A), as they are read
    graph: Tensor  # (B, C, N, N, K), with gradient
    velocity: Tensor  # (B, C, N, A) before the action
    next_x: Tensor
    next_graph: Tensor  # without gradient
    next_velocity: Tensor
    edge_entropy: Tensor  # nats, mean over all steps


class ActorCritic:
    """`gradient_clip` bounds the norm of each network's gradient; `rates` of the optimisers are the caller's to set."""

    def __init__(
        self,
        spec: SacSpec,
        policy: GraphPolicy,
        critic: TwinCritic,
        features: Features,
        integrator: Integrator,
        generators: Generators,
        gradient_clip: float,
    ) -> None:
        self.spec, self.gradient_clip = spec, gradient_clip
        self.policy, self.critic = policy, critic
        self.features, self.integrator, self.generators = features, integrator, generators
        self.device = next(policy.parameters()).device
        self.target_critic = deepcopy(critic).requires_grad_(False)
        self.log_temperature = torch.tensor(max(spec.temperature, 1e-8), device=self.device).log().requires_grad_()
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "actor": torch.optim.Adam(policy.parameters(), lr=spec.actor_learning_rate, fused=True),
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
        """The entropy's weight, as a tensor without gradient."""
        fixed = torch.tensor(self.spec.temperature, device=self.device)
        return self.log_temperature.detach().exp() if self.spec.automatic_temperature else fixed

    def update(
        self, batch: Batch, chosen: Callable[[int], Tensor], reward: Reward, *, actor_learns: bool = True
    ) -> dict[str, Tensor]:
        """One SAC step on the transitions of whole trajectories; `chosen` draws the time steps to use of T.

        Rewards are computed anew from the stored states and actions. Without `actor_learns` the policy and its
        temperature stay, and the critics learn what it is worth.
        """
        at = self._transitions(batch, chosen)
        with torch.no_grad():
            rewards = reward(at.x, at.actions)
            next_action, next_log_prob = self.policy.actor.sample_with_log_prob(
                at.next_x, at.next_graph, at.next_velocity, self._noise(at.actions)
            )
            next_action = self.features.of_actions(next_action)
            next_q = self.target_critic(at.next_x, next_action, at.next_graph)
            target = critic_target(rewards, next_q, next_log_prob, self.temperature, self.spec.gamma)
        value_loss = critic_loss(self.critic(at.x, at.actions, at.graph.detach()), target)
        self._step("critic", value_loss, self.critic.parameters())
        policy_loss, log_prob = self._update_actor(at, actor_learns)
        self._follow()
        return {
            "critic/loss": value_loss,
            "actor/loss": policy_loss,
            "temperature": self.temperature,
            "entropy": -log_prob.mean(),
            "graph/entropy": at.edge_entropy,
            "reward": rewards.mean(),
        }

    def _transitions(self, batch: Batch, chosen: Callable[[int], Tensor]) -> Transitions:
        a = batch.actions.shape[-1]
        states = batch.states[:, :-1]
        next_states = self.integrator.step(states, batch.actions)
        x = self.features(states, batch.states[:, 0])
        next_x = self.features(next_states, batch.states[:, 0], first_step=1)
        # The graph after step t is inferred from the states that the policy read, so one pass of the encoder serves
        # both ends of a transition.
        history = torch.cat([x, next_x[:, -1:]], dim=1)
        graphs, edge_entropy = self._graphs(history)
        at = chosen(x.shape[1])
        return Transitions(
            x=x[:, at],
            actions=self.features.of_actions(batch.actions[:, at]),
            graph=graphs[:, at],
            velocity=states[:, at, :, a:],
            next_x=next_x[:, at],
            next_graph=graphs[:, at + 1].detach(),
            next_velocity=next_states[:, at, :, a:],
            edge_entropy=edge_entropy,
        )

    def _graphs(self, history: Tensor) -> tuple[Tensor, Tensor]:
        """Sampled graphs (B, T, N, N, K) of features (B, T, N, F), and the entropy of their distribution.

        With sac.encoder_steps the gradient goes through that many consecutive steps alone, from a random one on:
        backpropagation through time, truncated. The values are the same.
        """
        b, t, n, _ = history.shape
        noise = (
            self.policy.draw_graph_noise(b, t, n, self.generators["policy"]).to(self.device).expand(b, t, -1, -1, -1)
        )
        learned = min(self.spec.encoder_steps or t, t)
        start = int(torch.randint(t - learned + 1, (), generator=self.generators["data"])) if learned < t else 0
        graphs, logits, memory = [], [], None
        for first, last in ((0, start), (start, start + learned), (start + learned, t)):
            if first < last:
                with torch.set_grad_enabled(first == start):
                    graph, logit, memory = self.policy.graphs(history[:, first:last], noise[:, first:last], memory)
                graphs.append(graph)
                logits.append(logit)
        return torch.cat(graphs, dim=1), graph_entropy(torch.cat(logits, dim=1))

    def _update_actor(self, at: Transitions, learns: bool) -> tuple[Tensor, Tensor]:
        action, log_prob = self.policy.actor.sample_with_log_prob(at.x, at.graph, at.velocity, self._noise(at.actions))
        action = self.features.of_actions(action)
        self.critic.requires_grad_(False)
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
    def _follow(self) -> None:
        """Move the target critics towards the critics (Polyak averaging)."""
        slow: list[Tensor] = list(self.target_critic.parameters())
        fast: list[Tensor] = list(self.critic.parameters())
        torch._foreach_lerp_(slow, fast, self.spec.polyak)

    def state_dict(self) -> dict[str, Any]:
        """Everything that an update changes."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()},
            "log_temperature": self.log_temperature.detach().clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        for name in ("policy", "critic", "target_critic"):
            getattr(self, name).load_state_dict(state[name])
        for name, values in state["optimizers"].items():
            self.optimizers[name].load_state_dict(values)
        with torch.no_grad():
            self.log_temperature.copy_(state["log_temperature"])
