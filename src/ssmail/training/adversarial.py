"""The adversarial learner (Alg. 1): a discriminator and a soft actor-critic that climbs its output.

ssail, gail and wail differ in one row of GAMES, and in whether tau_alpha joins the batches (self-supervision).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ssmail.config.sections import Pairing, SelfSupervisionSpec, required
from ssmail.config.user_functions import load_label
from ssmail.losses import Terms
from ssmail.losses.adversarial import (
    gail_loss,
    gail_reward,
    gradient_penalty,
    ssail_loss,
    ssail_reward,
    wail_loss,
    wail_reward,
)
from ssmail.losses.labels import checked_label
from ssmail.losses.self_supervision import assignment, mix, nearest, sample_alpha
from ssmail.models.critic import TwinCritic
from ssmail.models.discriminator import Discriminator
from ssmail.models.features import Features
from ssmail.models.normalization import ActionBounds
from ssmail.models.policy import GraphPolicy
from ssmail.training.actor_critic import ActorCritic
from ssmail.training.curricula import curriculum_metrics, draw_interventions, intervention_frequency
from ssmail.training.learning import Setting
from ssmail.training.learning_rates import DecayingRates
from ssmail.training.policy_predictor import PolicyPredictor
from ssmail.training.replay import Batch, Replay
from ssmail.training.rollout import rollout
from ssmail.training.updates import clipped_step, mean_of, with_noise


@dataclass(frozen=True)
class Game:
    """What makes a method: the discriminator's loss of its outputs on tau_G and tau_E (and on tau_alpha, with its
    labels), and the reward made of its output.
    """

    loss: Callable[..., tuple[Tensor, Terms]]
    reward: Callable[[Tensor], Tensor]


GAMES = {
    "ssail": Game(ssail_loss, ssail_reward),
    "gail": Game(gail_loss, gail_reward),
    "wail": Game(wail_loss, wail_reward),
}


class AdversarialLearner:
    """Networks, optimisers, the replay of tau_G, and an epoch of training."""

    def __init__(self, setting: Setting) -> None:
        spec = setting.spec
        model, sac = required(spec.model), required(spec.sac)
        self.setting, self.game = setting, GAMES[spec.method]
        self.adversarial, self.training = required(spec.adversarial), required(spec.training)
        self.curriculum = required(spec.curriculum)
        self.supervision, self.wasserstein = spec.self_supervision, spec.wasserstein
        self.label = None
        if self.supervision:
            self.label = checked_label(self.supervision, load_label(self.supervision.label))
        self.experts, self.generators, self.device = setting.experts, setting.generators, setting.device
        state_size, action_size = self.experts.states.shape[-1], self.experts.actions.shape[-1]
        self.features = Features.of(model, self.experts.states)
        inputs = self.features.size(state_size)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            policy = GraphPolicy(inputs, action_size, model, ActionBounds.of(model, self.features.normalization)).to(
                self.device
            )
            critic = TwinCritic(inputs + action_size, model).to(self.device)
            self.discriminator = Discriminator(inputs + action_size, model.hidden).to(self.device)
        self.actor_critic = ActorCritic(
            sac, policy, critic, self.features, setting.integrator, self.generators, self.training.gradient_clip
        )
        self.predictor = PolicyPredictor(policy, self.features, setting.integrator)
        self.optimizer = torch.optim.Adam(
            self.discriminator.parameters(),
            lr=self.adversarial.learning_rate,
            betas=(self.adversarial.beta1, 0.999),
            fused=True,
        )
        self.rates = DecayingRates(
            self.training,
            {**self.actor_critic.optimizers, "discriminator": self.optimizer},
            {**self.actor_critic.final_rates, "discriminator": self.adversarial.learning_rate_final},
        )
        self.replay = Replay(self.adversarial.replay)

    def networks(self) -> list[nn.Module]:
        """Policy, critics, discriminator."""
        return [self.actor_critic.policy, self.actor_critic.critic, self.discriminator]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Roll out, then update."""
        frequency = intervention_frequency(self.curriculum, epoch, self.training.epochs)
        self.rates.set(epoch)
        latest, interventions = self.generate(frequency)
        self.replay.add(latest)
        actor_learns = epoch >= (self.actor_critic.spec.actor_start or 0) * self.training.epochs
        values = mean_of([self.update(latest, actor_learns=actor_learns) for _ in range(self.training.updates)])
        return values | curriculum_metrics(frequency, [interventions])

    def generate(self, frequency: float) -> tuple[Batch, Tensor]:
        """tau_G from random training starts under the curriculum, and the interventions (B, T)."""
        count, steps = self.adversarial.rollouts, self.setting.steps
        source = torch.randint(len(self.experts), (count,), generator=self.generators["data"]).to(self.device)
        interventions = draw_interventions(count, steps, frequency, self.generators["curriculum"])
        expert = self.experts.states[source]
        made = rollout(
            self.actor_critic.policy,
            self.features,
            self.setting.integrator,
            expert[:, :1],
            steps,
            self.generators["policy"],
            expert=expert,
            interventions=interventions.to(self.device) if frequency > 0 else None,
        )
        return Batch(made.states, made.actions, source), interventions

    def update(self, latest: Batch, *, actor_learns: bool = True) -> dict[str, float]:
        """Discriminator steps, then one SAC step (two time scales); returns means of the losses."""
        logs = [self._update_discriminator(latest) for _ in range(self.adversarial.updates)]
        values = self.actor_critic.update(self._actor_batch(), self._pick_steps, self.reward, actor_learns=actor_learns)
        return mean_of(logs) | {name: float(value.detach()) for name, value in values.items()}

    def _update_discriminator(self, latest: Batch) -> dict[str, float]:
        b = self.training.batch
        past = round(b * self.adversarial.past_share)
        parts = [latest.draw(b - past, self.generators["data"])] if past < b else []
        if past:
            parts.append(self.replay.sample(past, self.generators["data"]))
        batches = [Batch.concatenate(parts), self.experts.draw(b, self.generators["data"])]
        labels: tuple[Tensor, ...] = ()
        if self.supervision and self.label:
            mixed, alpha = self._mixed(batches[0], self.supervision, self.supervision.pairing)
            batches.append(mixed)
            labels = (self.label(alpha),)
        everything = Batch.concatenate(batches)
        chosen = self._pick_steps(everything.actions.shape[1])
        states, actions = everything.states[:, :-1], everything.actions[:, chosen]
        x = self._blurred(self.features(states, states[:, 0])[:, chosen], states.shape[-1])
        actions = self._blurred(self.features.of_actions(actions))
        loss, terms = self.game.loss(*self.discriminator(x, actions).chunk(len(batches)), *labels)
        if self.wasserstein and self.wasserstein.constraint == "penalty":
            terms["penalty"] = self.wasserstein.penalty * self._penalty(x, actions)
            loss = loss + terms["penalty"]
        clipped_step(self.optimizer, loss, self.discriminator.parameters(), self.training.gradient_clip)
        if self.wasserstein and self.wasserstein.constraint == "clipping":
            self._clip_weights(self.wasserstein.clip)
        return {f"discriminator/{name}": float(value.detach()) for name, value in {"loss": loss, **terms}.items()}

    def _penalty(self, x: Tensor, actions: Tensor) -> Tensor:
        """The gradient penalty between the two halves of a batch: generated and expert."""
        (x_g, x_e), (a_g, a_e) = x.chunk(2), actions.chunk(2)
        weight = torch.rand(x_g.shape[:2], generator=self.generators["data"]).to(self.device)
        return gradient_penalty(self.discriminator, (x_g, a_g), (x_e, a_e), weight)

    @torch.no_grad()
    def _clip_weights(self, limit: float) -> None:
        for parameter in self.discriminator.parameters():
            parameter.clamp_(-limit, limit)

    def _actor_batch(self) -> Batch:
        """What the actor-critic learns from: tau_G, and with self-supervision tau_alpha in its share."""
        generated = self.replay.sample(self.training.batch, self.generators["data"])
        if not self.supervision:
            return generated
        count = round(len(generated) * self.supervision.actor_share)
        mixed, _ = self._mixed(generated[torch.arange(count)], self.supervision, self.supervision.actor_pairing)
        return Batch.concatenate([mixed, generated[torch.arange(count, len(generated))]])

    def reward(self, x: Tensor, actions: Tensor) -> Tensor:
        """(..., N) what the actor-critic is given for features x (..., N, F) and actions (..., N, A): the method's
        reward with today's discriminator, scaled and limited.
        """
        reward = self.adversarial.reward_scale * self.game.reward(self.discriminator(x, actions))
        limit = self.adversarial.reward_limit
        return reward if limit is None else reward.clamp(-limit, limit)

    def _pair(self, generated: Batch, pairing: Pairing) -> Batch:
        """The expert trajectory that each generated one is mixed with."""
        if pairing == "start":
            return self.experts[generated.source]
        if pairing == "nearest":
            return self.experts[nearest(generated.states, self.experts.states)]
        drawn = self.experts.draw(len(generated), self.generators["data"])
        return drawn[assignment(generated.states, drawn.states)]

    def _mixed(self, generated: Batch, supervision: SelfSupervisionSpec, pairing: Pairing) -> tuple[Batch, Tensor]:
        """tau_alpha and its alphas for a batch of tau_G."""
        alpha = sample_alpha(len(generated), supervision.alpha_pieces, self.generators["alpha"]).to(self.device)
        expert = self._pair(generated, pairing)
        states, actions = mix(generated.states, expert.states, alpha), mix(generated.actions, expert.actions, alpha)
        return Batch(states, actions, generated.source), alpha

    def _pick_steps(self, steps: int) -> Tensor:
        """The time steps that an update uses, in random order: all of them, or adversarial.time_steps of them."""
        order = torch.randperm(steps, generator=self.generators["data"])
        return order[: self.adversarial.time_steps].to(self.device)

    def _blurred(self, inputs: Tensor, features: int | None = None) -> Tensor:
        """`inputs` with Gaussian noise on the first `features` of them (all by default), so that D judges the track,
        not the jitter.
        """
        noisy = with_noise(inputs[..., :features], self.adversarial.input_noise, self.generators["data"])
        return noisy if features is None else torch.cat([noisy, inputs[..., features:]], dim=-1)

    def state_dict(self) -> dict[str, Any]:
        """Everything that an epoch changes, but for the generators."""
        return {
            "actor_critic": self.actor_critic.state_dict(),
            "discriminator": self.discriminator.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`."""
        for name in ("actor_critic", "discriminator", "optimizer", "replay"):
            getattr(self, name).load_state_dict(state[name])
