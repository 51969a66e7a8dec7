"""G-SAC (section 3.2.2): a graph policy, twin critics with target networks, a temperature, and their joint update.

`ActorCritic` is the state of one seed, and `SoftActorCritic` the algorithm, on the states of one or more seeds at once.
"""

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.config.sections import SacSpec
from ssmail.envs.integrator import IntegratorOfSeeds
from ssmail.losses import PER_SEED
from ssmail.losses.soft_actor_critic import critic_loss, critic_target, soft_value, temperature_loss
from ssmail.models.critic import TwinCritic
from ssmail.models.graph_encoder import edge_entropy, sample_graph
from ssmail.models.policy import Actor, GraphPolicy
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import entries, fitted, load_part
from ssmail.training.rollout import PolicyPredictor
from ssmail.training.seeding import Generators, GeneratorsOfSeeds, drawn, normal_like
from ssmail.training.stacking import Block, StackedAdam, fixed, stacked_modules

REPLACED = 1e-4  # scaled units: a next state that differs more from the integrator's is an intervention, not rounding
Reward = Callable[[Tensor, Tensor], Tensor]
"""Maps features (S, B, C, N, F) and actions as read (S, B, C, N, A) to rewards (S, B, C, N)."""


class ActorCritic:
    """Policy, critics and temperature of one seed, with their optimizers, whose learning rates the caller sets."""

    def __init__(self, spec: SacSpec, actor: PolicyPredictor, critic: TwinCritic, generators: Generators) -> None:
        self.spec, self.actor, self.generators = spec, actor, generators
        self.policy, self.critic = actor.model, critic
        self.target_critic = deepcopy(critic).requires_grad_(False)
        self.averaged = None if spec.average is None else deepcopy(actor.model).requires_grad_(False)
        device = next(critic.parameters()).device
        self.log_temperature = torch.tensor(max(spec.temperature, 1e-8), device=device).log().requires_grad_()
        self.optimizers = {
            "actor": torch.optim.Adam(self.policy.parameters(), lr=spec.actor_learning_rate, fused=True),
            "critic": torch.optim.Adam(critic.parameters(), lr=spec.critic_learning_rate, fused=True),
            "temperature": torch.optim.Adam([self.log_temperature], lr=spec.temperature_learning_rate, fused=True),
        }
        self.final_rates = {
            "actor": spec.actor_learning_rate_final,
            "critic": spec.critic_learning_rate_final,
            "temperature": spec.actor_learning_rate_final,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return everything that an update changes."""
        averaged = {} if self.averaged is None else {"averaged": self.averaged.state_dict()}
        return {
            **averaged,
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
        for name in ("policy", "critic", "target_critic", *(("averaged",) if self.averaged else ())):
            load_part(getattr(self, name), state[name], f"learner.actor_critic.{name}")
        for name, optimizer in self.optimizers.items():
            load_part(optimizer, optimizers[name], f"learner.actor_critic.optimizers.{name}")
        with torch.no_grad():
            where = "learner.actor_critic.log_temperature"
            self.log_temperature.copy_(fitted(state["log_temperature"], own["log_temperature"], where))


@dataclass(frozen=True)
class Transitions:
    """A training batch of actors and critics: C time steps from each of B trajectories of S seeds."""

    x: Tensor  # (S, B, C, N, F)
    actions: Tensor  # (S, B, C, N, A), as the networks read them
    graph: Tensor  # (S, B, C, N, N, K), with gradient
    states: Tensor  # (S, B, C, N, D)
    next_x: Tensor
    next_graph: Tensor  # detached
    next_velocity: Tensor
    edge_entropy: Tensor  # (S,), nats, means over all edges and steps
    # for what comes after these steps
    steps: Tensor  # (S, C)
    histories: Tensor  # (S, B, T + 1, N, F) features of the whole trajectories
    graphs: Tensor  # (S, B, T + 1, N, N, K), with gradient


class SoftActorCritic:
    """Updates of the actors and critics of S seeds at once, each as if it were alone.

    The norm of each network's gradient is clipped to `gradient_clip`.
    """

    def __init__(self, seeds: Sequence[ActorCritic], gradient_clip: float) -> None:
        first = seeds[0]
        self.spec, self.features = first.spec, first.actor.features
        self.integrator = IntegratorOfSeeds.of([seed.actor.integrator for seed in seeds], first.log_temperature)
        self.generators = GeneratorsOfSeeds([seed.generators for seed in seeds])
        self.policy: GraphPolicy
        self.critic: TwinCritic
        self.target_critic: TwinCritic
        self.policy, policy = stacked_modules([seed.policy for seed in seeds])
        self.critic, critic = stacked_modules([seed.critic for seed in seeds])
        self.target_critic, target = stacked_modules([seed.target_critic for seed in seeds])
        self.fixed_critic, self.fixed_actor = fixed(self.critic), fixed(self.policy.actor)
        temperature = Block([[seed.log_temperature] for seed in seeds])
        self.log_temperature = nn.Parameter(temperature.parts[0])
        learned: dict[str, tuple[Iterable[nn.Parameter], Block]] = {
            "actor": (self.policy.parameters(), policy),
            "critic": (self.critic.parameters(), critic),
            "temperature": ([self.log_temperature], temperature),
        }
        self.optimizers = {
            name: StackedAdam(list(parameters), block, [seed.optimizers[name] for seed in seeds], gradient_clip)
            for name, (parameters, block) in learned.items()
        }
        self.policy_values, self.critic_values, self.target_values = policy.values, critic.values, target.values
        averaged = [list(seed.averaged.parameters()) for seed in seeds if seed.averaged is not None]
        self.averaged_values = Block(averaged).values if averaged else None

    @property
    def temperature(self) -> Tensor:
        """The entropy's weights (S,), detached."""
        learned = self.log_temperature.detach().exp()
        return learned if self.spec.automatic_temperature else torch.full_like(learned, self.spec.temperature)

    def update(
        self, batch: Batch, steps: Tensor, reward: Reward, *, expansion_steps: int = 0, actor_learns: bool = True
    ) -> dict[str, Tensor]:
        """Take one SAC step on whole trajectories (S, B, ...), at their time steps `steps` (S, C).

        Rewards are recomputed from the stored states and actions. expansion_steps: of the actors' objective. Without
        `actor_learns` the policies and their temperatures stay fixed while the critics learn the policies' values.
        Returns losses and means, (S,) each.
        """
        at = self._transitions(batch, steps)
        temperature = self.temperature.view(-1, 1, 1, 1)
        # Critics: one regression step to r + gamma * (min target Q - temperature * log pi) of the next state.
        with torch.no_grad():
            rewards = reward(at.x, at.actions)
            next_action, next_log_prob = self._sample(self.policy.actor, at.next_x, at.next_graph, at.next_velocity)
            next_q = self.target_critic(at.next_x, self.features.normalize_actions(next_action), at.next_graph)
            next_value = soft_value(next_q, next_log_prob, temperature)
            target = critic_target(rewards, next_value, self._discount(at, 1))
        value_loss = critic_loss(self.critic(at.x, at.actions, at.graph.detach()), target)
        self.optimizers["critic"].step(value_loss)
        # Actor and temperature.
        policy_loss, log_prob = self._update_actor(at, temperature, reward, expansion_steps, actor_learns)
        # Target networks and averaged policies.
        self._update_averages()
        return {
            "critic/loss": value_loss,
            "actor/loss": policy_loss,
            "temperature": self.temperature,
            "entropy": -log_prob.mean(dim=PER_SEED),
            "graph/entropy": at.edge_entropy,
            "reward": rewards.mean(dim=PER_SEED),
        }

    def _transitions(self, batch: Batch, steps: Tensor) -> Transitions:
        """Infer the graphs of whole trajectories, then pick time steps."""
        a = batch.actions.shape[-1]
        start, states = batch.states[..., 0, :, :], batch.states[..., :-1, :, :]
        next_states = self.integrator.step(states, batch.actions)
        x = self.features(states, start)
        next_x = self.features(next_states, start, first_step=1)
        # One pass of the encoder over all T + 1 states gives the graphs at both ends of every transition.
        histories = torch.cat([x, next_x[..., -1:, :, :]], dim=-3)
        noise = self._draw_graph_noise(histories)
        graphs, entropy = self._graphs(histories, noise)
        # An intervention put the expert's state in the place of the one that followed, which that graph has not read.
        replaced = (batch.states[..., 1:, :, :] - next_states).abs().amax(dim=(-2, -1)) > REPLACED
        replaced = at_steps(replaced, steps)
        next_graph = at_steps(graphs.detach(), steps + 1)
        if replaced.any():
            logits = self.policy.encoder.logits_after(x, steps, at_steps(next_x, steps))
            read = sample_graph(logits, at_steps(noise, steps + 1), self.policy.graph_temperature)
            next_graph = torch.where(replaced[..., None, None, None], read.round(), next_graph)  # exactly one-hot
        return Transitions(
            x=at_steps(x, steps),
            actions=self.features.normalize_actions(at_steps(batch.actions, steps)),
            graph=at_steps(graphs, steps),
            states=at_steps(states, steps),
            next_x=at_steps(next_x, steps),
            next_graph=next_graph,
            next_velocity=at_steps(next_states, steps)[..., a:],
            edge_entropy=entropy,
            steps=steps,
            histories=histories,
            graphs=graphs,
        )

    def _draw_graph_noise(self, history: Tensor) -> Tensor:
        """Draw the noise of the graphs of features (S, B, T, N, F); it broadcasts to (S, B, T, N, N, K)."""
        _, b, t, n, _ = history.shape
        noise = drawn(self.generators["policy"], lambda g: self.policy.draw_graph_noise(b, t, n, g))
        return noise.to(history.device).expand(-1, b, t, -1, -1, -1)

    def _graphs(self, history: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Sample graphs (S, B, T, N, N, K) from features (S, B, T, N, F); return them with their entropy (S,) in nats.

        Truncated backpropagation through time: with sac.encoder_steps, the gradient flows through a random window of
        that many consecutive steps only. The values do not depend on the window.
        """
        t = history.shape[2]
        learned = min(self.spec.encoder_steps or t, t)
        if learned < t:
            return self._graphs_of_windows(history, noise, learned)
        graphs, logits, _ = self.policy.graphs(history, noise)
        return graphs, edge_entropy(logits).mean(dim=(1, 2))

    def _graphs_of_windows(self, history: Tensor, noise: Tensor, learned: int) -> tuple[Tensor, Tensor]:
        """Read the steps before, in and after a window of `learned` steps in turn; only the window has a gradient.

        For a single seed, because every seed has a window of its own.
        """
        t = history.shape[2]
        (generator,) = self.generators["data"]
        start = int(torch.randint(t - learned + 1, (), generator=generator))
        graphs, logits, memory = [], [], None
        for first, last in ((0, start), (start, start + learned), (start + learned, t)):
            if first < last:
                with torch.set_grad_enabled(first == start):
                    graph, logit, memory = self.policy.graphs(
                        history[:, :, first:last], noise[:, :, first:last], memory
                    )
                graphs.append(graph)
                logits.append(logit)
        return torch.cat(graphs, dim=2), edge_entropy(torch.cat(logits, dim=2)).mean(dim=(1, 2))

    def _sample(self, actor: Actor, x: Tensor, graph: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Sample actions, in scaled units, with their log-probabilities."""
        noise = normal_like(velocity, self.generators["policy"])
        return actor.sample_with_log_prob(x, graph, velocity, noise)

    def _update_actor(
        self, at: Transitions, temperature: Tensor, reward: Reward, expansion_steps: int, learns: bool
    ) -> tuple[Tensor, Tensor]:
        """Take one step of actors and graph encoders, then one of the temperatures; return the losses and log pi."""
        loss, log_prob = self._actor_loss(at, temperature, reward, expansion_steps)
        if learns:
            self.optimizers["actor"].step(loss - self.spec.graph_entropy * at.edge_entropy)
        if learns and self.spec.automatic_temperature:
            assert self.spec.target_entropy is not None  # resolved by then
            target_entropy = self.spec.target_entropy * at.actions.shape[-1]
            learned = self.log_temperature.view(-1, 1, 1, 1)
            self.optimizers["temperature"].step(temperature_loss(learned, log_prob, target_entropy))
        return loss, log_prob

    def _actor_loss(
        self, at: Transitions, temperature: Tensor, reward: Reward, expansion_steps: int
    ) -> tuple[Tensor, Tensor]:
        """Return minus the soft value (S,) of the policy's actions at the transitions' states, and their log pi.

        The value is r + gamma * r' + ... of `expansion_steps` steps, then that of the critics, each less temperature *
        log pi (model-based value expansion, Feinberg et al. 2018). Rewards and dynamics are known functions, so the
        gradient reaches an action through all that follows from it. As in Q(s, a), the policy that acts afterwards is
        given: a gradient through its weights as well would let the whole group change its lane at once, whatever graph
        it has (docs/experiments.md). The graphs are those of the stored trajectory at the same time.
        """
        states, read = at.states, at.x
        size, last = states.shape[-1], at.graphs.shape[2] - 1
        graph = at.graph.detach()
        action, log_prob = self._sample(self.policy.actor, read, at.graph, states[..., size // 2 :])
        first_log_prob, value = log_prob, torch.zeros_like(log_prob)
        for k in range(expansion_steps):
            rewards = reward(read, self.features.normalize_actions(action))
            value = value + self._discount(at, k) * (rewards - temperature * log_prob)
            states = self.integrator.step(states, action)
            now = (at.steps + k + 1).clamp(max=last)
            others = at_steps(at.histories, now)[..., size:]
            read = torch.cat([self.features.normalize_states(states), others], dim=-1)
            graph = at_steps(at.graphs, now).detach()
            action, log_prob = self._sample(self.fixed_actor, read, graph, states[..., size // 2 :])
        q = self.fixed_critic(read, self.features.normalize_actions(action), graph)
        value = value + self._discount(at, expansion_steps) * soft_value(q, log_prob, temperature)
        return -value.mean(dim=PER_SEED), first_log_prob

    def _discount(self, at: Transitions, ahead: int) -> Tensor | float:
        """Return the discount of the value `ahead` steps after the transitions: gamma**ahead or, with a finite horizon,
        (S, 1, C, 1) with zeros where the trajectory has ended by then.
        """
        discount: float = self.spec.gamma**ahead
        if not self.spec.finite_horizon:
            return discount
        follows = at.steps + ahead < at.graphs.shape[2] - 1
        return discount * follows.to(at.x.dtype).unsqueeze(1).unsqueeze(-1)

    @torch.no_grad()
    def _update_averages(self) -> None:
        """Move the target networks towards the critics, target += polyak * (critic - target), and the averaged policies
        towards the policies.
        """
        self.target_values.lerp_(self.critic_values, self.spec.polyak)
        if self.averaged_values is not None and self.spec.average is not None:
            self.averaged_values.lerp_(self.policy_values, self.spec.average)


def at_steps(x: Tensor, steps: Tensor) -> Tensor:
    """Return x (S, B, T, ...) at the time steps (S, C) of each seed: (S, B, C, ...)."""
    s, b = x.shape[:2]
    seeds, rows = torch.arange(s, device=x.device), torch.arange(b, device=x.device)
    return x[seeds.view(s, 1, 1), rows.view(1, b, 1), steps.unsqueeze(1)]
