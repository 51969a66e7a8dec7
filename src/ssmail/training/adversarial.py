"""The adversarial learner (Alg. 1): a discriminator trained on Eq. 3 and a soft actor-critic that climbs its output."""

from collections import defaultdict
from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.envs.integrator import Integrator
from ssmail.losses.adversarial import ssail_loss
from ssmail.losses.self_supervision import assignment, mix, nearest, sample_alpha
from ssmail.losses.soft_actor_critic import actor_loss, critic_loss, critic_target, temperature_loss
from ssmail.models.critic import TwinCritic
from ssmail.models.discriminator import Discriminator
from ssmail.models.features import Features
from ssmail.models.graph_encoder import graph_entropy
from ssmail.models.policy import GraphPolicy
from ssmail.rewards import ssail_reward
from ssmail.spec import Pairing, RunSpec
from ssmail.training.replay import Batch, Replay
from ssmail.training.seeding import Generators


class AdversarialLearner:
    """Networks, optimisers and one update. `experts` holds the scaled training trajectories."""

    def __init__(
        self, spec: RunSpec, experts: Batch, features: Features, integrator: Integrator, generators: Generators
    ) -> None:
        self.spec, self.experts, self.generators = spec, experts, generators
        self.features, self.integrator = features, integrator
        self.device = experts.states.device
        action_size = experts.actions.shape[-1]
        inputs = features.size(experts.states.shape[-1])
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generators.seeds["weights"])
            self.policy = GraphPolicy(inputs, action_size, spec.model)
            self.critic = TwinCritic(inputs + action_size, spec.model)
            self.discriminator = Discriminator(inputs + action_size, spec.model.hidden)
        for network in (self.policy, self.critic, self.discriminator):
            network.to(self.device)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)
        self.average = deepcopy(self.policy).requires_grad_(False)
        self.log_temperature = torch.tensor(max(spec.sac.temperature, 1e-8), device=self.device).log().requires_grad_()
        self.optimizers = {
            "actor": torch.optim.Adam(self.policy.parameters(), lr=spec.sac.actor_learning_rate, fused=True),
            "critic": torch.optim.Adam(self.critic.parameters(), lr=spec.sac.critic_learning_rate, fused=True),
            "discriminator": torch.optim.Adam(
                self.discriminator.parameters(), lr=spec.adversarial.learning_rate, fused=True
            ),
            "temperature": torch.optim.Adam([self.log_temperature], lr=spec.sac.temperature_learning_rate, fused=True),
        }
        self.first_rates = {name: o.param_groups[0]["lr"] for name, o in self.optimizers.items()}
        self.final_factors = {
            "actor": spec.sac.actor_learning_rate_final,
            "critic": spec.sac.critic_learning_rate_final,
            "discriminator": spec.adversarial.learning_rate_final,
            "temperature": spec.sac.actor_learning_rate_final,
        }

    @property
    def temperature(self) -> Tensor:
        """The entropy's weight, as a tensor without gradient."""
        fixed = torch.tensor(self.spec.sac.temperature, device=self.device)
        return self.log_temperature.detach().exp() if self.spec.sac.automatic_temperature else fixed

    def evaluated_policy(self) -> GraphPolicy:
        """The policy that metrics are measured on: the averaged one when the spec asks for averaging."""
        return self.average if self.spec.training.policy_average > 0 else self.policy

    def set_learning_rates(self, decayed: float) -> None:
        """Put the learning rates at the fraction `decayed` (0 .. 1) of the geometric way from first to final values."""
        for name, optimizer in self.optimizers.items():
            optimizer.param_groups[0]["lr"] = self.first_rates[name] * self.final_factors[name] ** decayed

    def update(self, latest: Batch, replay: Replay) -> dict[str, float]:
        """Discriminator steps, then one SAC step (two time scales); returns means of the losses."""
        logs: dict[str, list[float]] = defaultdict(list)
        for _ in range(self.spec.adversarial.updates):
            self._log(logs, self._update_discriminator(latest, replay))
        self._log(logs, self._update_actor_critic(replay))
        return {name: sum(values) / len(values) for name, values in logs.items()}

    @staticmethod
    def _log(logs: dict[str, list[float]], values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            logs[name].append(float(value.detach()))

    def _pick(self, source: Batch, count: int) -> Batch:
        return source[torch.randint(len(source), (count,), generator=self.generators["data"]).to(self.device)]

    def _pair(self, generated: Batch, pairing: Pairing) -> Batch:
        """The expert trajectory that each generated one is mixed with."""
        if pairing == "start":
            return self.experts[generated.source]
        if pairing == "nearest":
            return self.experts[nearest(generated.states, self.experts.states)]
        drawn = self._pick(self.experts, len(generated))
        return drawn[assignment(generated.states, drawn.states)]

    def _mixed(self, generated: Batch, pairing: Pairing) -> tuple[Batch, Tensor]:
        """tau_alpha and its alphas for a batch of tau_G."""
        low, high = self.spec.adversarial.alpha_low, self.spec.adversarial.alpha_high
        alpha = sample_alpha(len(generated), low, high, self.generators["alpha"]).to(self.device)
        expert = self._pair(generated, pairing)
        states, actions = mix(generated.states, expert.states, alpha), mix(generated.actions, expert.actions, alpha)
        return Batch(states, actions, generated.source), alpha

    def _pick_steps(self, steps: int) -> Tensor:
        """The time steps that an update uses, in random order: all of them, or training.time_steps of them."""
        order = torch.randperm(steps, generator=self.generators["data"])
        return order[: self.spec.training.time_steps].to(self.device)

    def _inputs(self, batch: Batch) -> Tensor:
        """Features of the states in which actions were taken: (B, T, N, F)."""
        return self.features(batch.states[:, :-1], batch.states[:, 0])

    def _update_discriminator(self, latest: Batch, replay: Replay) -> dict[str, Tensor]:
        b = self.spec.training.batch
        past = round(b * self.spec.adversarial.past_share)
        parts = [self._pick(latest, b - past)] if past < b else []
        if past:
            parts.append(replay.sample(past, self.generators["data"]))
        generated = Batch.concatenate(parts)
        expert = self._pick(self.experts, b)
        mixed, alpha = self._mixed(generated, self.spec.adversarial.pairing)
        everything = Batch.concatenate([generated, expert, mixed])
        chosen = self._pick_steps(everything.actions.shape[1])
        x, actions = self._inputs(everything)[:, chosen], everything.actions[:, chosen]
        outputs = self.discriminator(self._blurred(x, self.experts.states.shape[-1]), self._blurred(actions))
        on_generated, on_expert, on_mixed = outputs.chunk(3)
        loss, terms = ssail_loss(on_generated, on_expert, on_mixed, alpha)
        self._step("discriminator", loss, self.discriminator.parameters())
        return {"discriminator/loss": loss, **{f"discriminator/{k}": v for k, v in terms.items()}}

    def _blurred(self, inputs: Tensor, features: int | None = None) -> Tensor:
        """`inputs` with Gaussian noise on the first `features` of them (all by default), so that D judges the track,
        not the jitter.
        """
        std = self.spec.adversarial.input_noise
        if std == 0:
            return inputs
        noise = torch.randn(*inputs[..., :features].shape, generator=self.generators["data"]).to(self.device)
        return torch.cat([inputs[..., :features] + std * noise, inputs[..., noise.shape[-1] :]], dim=-1)

    def _update_actor_critic(self, replay: Replay) -> dict[str, Tensor]:
        b = self.spec.training.batch
        count = round(b * self.spec.sac.mixed_share)
        generated = replay.sample(b, self.generators["data"])
        mixed, _ = self._mixed(generated[torch.arange(count)], self.spec.sac.pairing)
        batch = Batch.concatenate([mixed, generated[torch.arange(count, b)]])

        a = self.experts.actions.shape[-1]
        states, actions = batch.states[:, :-1], batch.actions
        next_states = self.integrator.step(states, actions)
        x = self._inputs(batch)
        next_x = self.features(next_states, batch.states[:, 0], first_step=1)
        # The graph after step t is inferred from the states that the policy read, so one pass of the encoder serves
        # both ends of a transition.
        history = torch.cat([x, next_x[:, -1:]], dim=1)
        noise = self.policy.draw_graph_noise(b, history.shape[1], states.shape[2], self.generators["policy"])
        graphs, logits, _ = self.policy.graphs(history, noise.to(self.device))
        chosen = self._pick_steps(x.shape[1])
        graph, next_graph = graphs[:, chosen], graphs[:, chosen + 1].detach()
        x, next_x, actions = x[:, chosen], next_x[:, chosen], actions[:, chosen]
        states, next_states = states[:, chosen], next_states[:, chosen]

        with torch.no_grad():
            reward = self.spec.adversarial.reward_scale * ssail_reward(self.discriminator(x, actions))
            next_action, next_log_prob = self.policy.actor.sample_with_log_prob(
                next_x, next_graph, next_states[..., a:], self._noise(actions)
            )
            next_q = self.target_critic(next_x, next_action, next_graph)
            target = critic_target(reward, next_q, next_log_prob, self.temperature, self.spec.sac.gamma)
        fixed_graph = graph.detach()
        value_loss = critic_loss(self.critic(x, actions, fixed_graph), target)
        self._step("critic", value_loss, self.critic.parameters())

        action, log_prob = self.policy.actor.sample_with_log_prob(x, graph, states[..., a:], self._noise(actions))
        self.critic.requires_grad_(False)
        policy_loss = actor_loss(self.critic(x, action, fixed_graph), log_prob, self.temperature)
        self.critic.requires_grad_(True)
        edge_entropy = graph_entropy(logits)
        self._step("actor", policy_loss - self.spec.sac.graph_entropy * edge_entropy, self.policy.parameters())
        if self.spec.sac.automatic_temperature:
            target_entropy = self.spec.sac.target_entropy * a
            self._step(
                "temperature", temperature_loss(self.log_temperature, log_prob, target_entropy), [self.log_temperature]
            )
        self._follow()
        return {
            "critic/loss": value_loss,
            "actor/loss": policy_loss,
            "temperature": self.temperature,
            "entropy": -log_prob.mean(),
            "graph/entropy": edge_entropy,
            "reward": reward.mean(),
        }

    def _noise(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.generators["policy"]).to(self.device)

    def _step(self, name: str, loss: Tensor, parameters: Iterable[Tensor]) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(parameters, self.spec.training.gradient_clip)
        optimizer.step()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the target critics (Polyak averaging) and the averaged policy towards their sources."""
        pairs: list[tuple[nn.Module, nn.Module, float]] = [(self.target_critic, self.critic, self.spec.sac.polyak)]
        if self.spec.training.policy_average > 0:
            pairs.append((self.average, self.policy, 1 - self.spec.training.policy_average))
        for follower, source, rate in pairs:
            torch._foreach_lerp_(list(follower.parameters()), list(source.parameters()), rate)

    def state_dict(self) -> dict[str, Any]:
        """Everything that an update changes."""
        networks = {n: getattr(self, n).state_dict() for n in NETWORKS}
        optimizers = {n: o.state_dict() for n, o in self.optimizers.items()}
        return {
            "networks": networks,
            "optimizers": optimizers,
            "log_temperature": self.log_temperature.detach().clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        for name, values in state["networks"].items():
            getattr(self, name).load_state_dict(values)
        for name, values in state["optimizers"].items():
            self.optimizers[name].load_state_dict(values)
        with torch.no_grad():
            self.log_temperature.copy_(state["log_temperature"])


NETWORKS = ("policy", "average", "critic", "target_critic", "discriminator")
