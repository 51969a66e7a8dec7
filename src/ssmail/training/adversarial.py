"""The adversarial learner (Alg. 1): a discriminator, and a soft actor-critic that maximizes the reward made of it.

ssail, gail and wail differ in one row of OBJECTIVES, and in whether tau_alpha joins the batches (self-supervision,
section 3.1.2).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
from ssmail.training.actor_critic import ActorCritic
from ssmail.training.batches import Batch, ReplayBuffer
from ssmail.training.checkpoint import Stateful
from ssmail.training.curricula import curriculum_metrics, draw_interventions, intervention_frequency
from ssmail.training.learner import LearnerContext
from ssmail.training.optimization import LearningRateSchedule, add_noise, clipped_step, mean_metrics
from ssmail.training.rollout import PolicyPredictor


@dataclass(frozen=True)
class AdversarialObjective:
    """The two functions that define a method.

    loss: the discriminator's loss from its outputs on tau_G and tau_E (and, for ssail, on tau_alpha and its labels).
    reward: the actor-critic's reward from the discriminator's output.
    """

    loss: Callable[..., tuple[Tensor, Terms]]
    reward: Callable[[Tensor], Tensor]


OBJECTIVES = {
    "ssail": AdversarialObjective(ssail_loss, ssail_reward),  # Eq. 3
    "gail": AdversarialObjective(gail_loss, gail_reward),  # Eq. 1
    "wail": AdversarialObjective(wail_loss, wail_reward),  # Eq. 2
}


class AdversarialLearner:
    """Alternates discriminator steps and soft actor-critic steps on trajectories from a replay buffer."""

    def __init__(self, context: LearnerContext) -> None:
        spec = context.spec
        model, sac = required(spec.model), required(spec.sac)
        self.context, self.objective = context, OBJECTIVES[spec.method]
        self.adversarial, self.training = required(spec.adversarial), required(spec.training)
        self.curriculum = required(spec.curriculum)
        self.supervision, self.wasserstein = spec.self_supervision, spec.wasserstein
        self.label = None
        if self.supervision:
            self.label = checked_label(self.supervision, load_label(self.supervision.label))
        self.experts, self.generators, self.device = context.experts, context.generators, context.device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            self.predictor = PolicyPredictor.create(model, self.experts, context.integrator)
            self.features = self.predictor.features
            inputs = self.features.size(self.experts.states.shape[-1]) + self.experts.actions.shape[-1]
            critic = TwinCritic(inputs, model).to(self.device)
            self.discriminator = Discriminator(inputs, model.hidden).to(self.device)
        self.actor_critic = ActorCritic(sac, self.predictor, critic, self.generators, self.training.gradient_clip)
        self.optimizer = torch.optim.Adam(
            self.discriminator.parameters(),
            lr=self.adversarial.learning_rate,
            betas=(self.adversarial.beta1, 0.999),
            fused=True,
        )
        self.schedule = LearningRateSchedule(
            self.training,
            {**self.actor_critic.optimizers, "discriminator": self.optimizer},
            {**self.actor_critic.final_rates, "discriminator": self.adversarial.learning_rate_final},
        )
        self.replay = ReplayBuffer(self.adversarial.replay, self.experts)

    def networks(self) -> list[nn.Module]:
        """Return policy, critics and discriminator."""
        return [self.actor_critic.policy, self.actor_critic.critic, self.discriminator]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Roll out once under the curriculum, then take training.updates updates (Alg. 1)."""
        frequency = intervention_frequency(self.curriculum, epoch, self.training.epochs)
        self.schedule.set(epoch)
        # tau_G from the current policy, into the replay buffer.
        latest, interventions = self.generate(frequency)
        self.replay.add(latest)
        # Warm-up: until sac.actor_start, the fraction of all epochs, only the critics and the discriminator learn.
        actor_learns = epoch >= (self.actor_critic.spec.actor_start or 0) * self.training.epochs
        values = mean_metrics([self.update(latest, actor_learns=actor_learns) for _ in range(self.training.updates)])
        return values | curriculum_metrics(frequency, [interventions])

    def generate(self, frequency: float) -> tuple[Batch, Tensor]:
        """Generate tau_G from random training starts, and return it with the interventions (B, T).

        `frequency` is the curriculum's probability of an intervention per step (trajectory forcing, section 3.3).
        """
        count, steps = self.adversarial.rollouts, self.context.steps
        source = torch.randint(len(self.experts), (count,), generator=self.generators["data"]).to(self.device)
        interventions = draw_interventions(count, steps, frequency, self.generators["curriculum"])
        expert = self.experts.states[source]
        made = self.predictor.rollout(
            expert[:, :1],
            steps,
            self.generators["policy"],
            expert=expert,
            interventions=interventions.to(self.device) if frequency > 0 else None,
        )
        return Batch(made.states, made.actions, source), interventions

    def update(self, latest: Batch, *, actor_learns: bool = True) -> dict[str, float]:
        """Take adversarial.updates discriminator steps, then one SAC step (two time scales). Returns mean losses."""
        logs = [self._update_discriminator(latest) for _ in range(self.adversarial.updates)]
        values = self.actor_critic.update(self._actor_batch(), self._pick_steps, self.reward, actor_learns=actor_learns)
        return mean_metrics(logs) | {name: float(value.detach()) for name, value in values.items()}

    def _update_discriminator(self, latest: Batch) -> dict[str, float]:
        # tau_G: fresh rollouts, and a share of past ones from the replay buffer. tau_E: the expert's.
        b = self.training.batch
        past = round(b * self.adversarial.past_share)
        parts = [latest.draw(b - past, self.generators["data"])] if past < b else []
        if past:
            parts.append(self.replay.sample(past, self.generators["data"]))
        batches = [Batch.concatenate(parts), self.experts.draw(b, self.generators["data"])]
        # tau_alpha and its labels (self-supervision).
        labels: tuple[Tensor, ...] = ()
        if self.supervision and self.label:
            mixed, alpha = self._mixed(batches[0], self.supervision, self.supervision.pairing)
            batches.append(mixed)
            labels = (self.label(alpha),)
        # One pass of D over all parts at the same random time steps; its outputs are then split again (Eq. 3).
        everything = Batch.concatenate(batches)
        chosen = self._pick_steps(everything.actions.shape[1])
        states, actions = everything.states[:, :-1], everything.actions[:, chosen]
        x = self._add_input_noise(self.features(states, states[:, 0])[:, chosen], states.shape[-1])
        actions = self._add_input_noise(self.features.normalize_actions(actions))
        loss, terms = self.objective.loss(*self.discriminator(x, actions).chunk(len(batches)), *labels)
        # wail bounds D's slope by a gradient penalty, or by clipping its weights.
        if self.wasserstein and self.wasserstein.constraint == "penalty":
            (x_g, x_e), (a_g, a_e) = x.chunk(2), actions.chunk(2)
            weight = torch.rand(x_g.shape[:2], generator=self.generators["data"]).to(self.device)
            penalty = gradient_penalty(self.discriminator, (x_g, a_g), (x_e, a_e), weight)
            terms["penalty"] = self.wasserstein.penalty * penalty
            loss = loss + terms["penalty"]
        clipped_step(self.optimizer, loss, self.discriminator.parameters(), self.training.gradient_clip)
        if self.wasserstein and self.wasserstein.constraint == "clipping":
            with torch.no_grad():
                for parameter in self.discriminator.parameters():
                    parameter.clamp_(-self.wasserstein.clip, self.wasserstein.clip)
        return {f"discriminator/{name}": float(value.detach()) for name, value in {"loss": loss, **terms}.items()}

    def _actor_batch(self) -> Batch:
        """Draw the actor-critic's batch from the replay buffer.

        With self-supervision, tau_alpha replaces the first self_supervision.actor_share of tau_G: the dynamics are
        affine, so an off-policy critic can learn from the mix (section 3.1.2).
        """
        generated = self.replay.sample(self.training.batch, self.generators["data"])
        if not self.supervision:
            return generated
        count = round(len(generated) * self.supervision.actor_share)
        mixed, _ = self._mixed(generated[torch.arange(count)], self.supervision, self.supervision.actor_pairing)
        return Batch.concatenate([mixed, generated[torch.arange(count, len(generated))]])

    def reward(self, x: Tensor, actions: Tensor) -> Tensor:
        """Return the rewards (..., N) of features x (..., N, F) and actions (..., N, A).

        The method's reward with the current discriminator, scaled by adversarial.reward_scale and clipped to
        adversarial.reward_limit.
        """
        return self._as_reward(self.discriminator(x, actions))

    def agent_reward(self, agent: int, own: Tensor, x: Tensor, actions: Tensor) -> Tensor:
        """Return the rewards (...) of one agent as `reward` does, with features `own` (..., F) for its row of x.

        Leading axes broadcast; see `Discriminator.score_agent`.
        """
        return self._as_reward(self.discriminator.score_agent(agent, own, x, actions))

    def _as_reward(self, output: Tensor) -> Tensor:
        reward = self.adversarial.reward_scale * self.objective.reward(output)
        limit = self.adversarial.reward_limit
        return reward if limit is None else reward.clamp(-limit, limit)

    def _pair(self, generated: Batch, pairing: Pairing) -> Batch:
        """Return the expert trajectory with which to mix each generated one."""
        if pairing == "start":
            return self.experts[generated.source]
        if pairing == "nearest":
            return self.experts[nearest(generated.states, self.experts.states)]
        drawn = self.experts.draw(len(generated), self.generators["data"])
        return drawn[assignment(generated.states, drawn.states)]

    def _mixed(self, generated: Batch, supervision: SelfSupervisionSpec, pairing: Pairing) -> tuple[Batch, Tensor]:
        """Mix a batch of tau_G with its expert partners: tau_alpha and alpha (B,), section 3.1."""
        alpha = sample_alpha(len(generated), supervision.alpha_pieces, self.generators["alpha"]).to(self.device)
        expert = self._pair(generated, pairing)
        states, actions = mix(generated.states, expert.states, alpha), mix(generated.actions, expert.actions, alpha)
        return Batch(states, actions, generated.source), alpha

    def _pick_steps(self, steps: int) -> Tensor:
        """Draw the time steps of an update in random order: all, or adversarial.time_steps of them."""
        order = torch.randperm(steps, generator=self.generators["data"])
        return order[: self.adversarial.time_steps].to(self.device)

    def _add_input_noise(self, inputs: Tensor, features: int | None = None) -> Tensor:
        """Add Gaussian noise to the first `features` inputs (all by default), so that D ignores jitter."""
        noisy = add_noise(inputs[..., :features], self.adversarial.input_noise, self.generators["data"])
        return noisy if features is None else torch.cat([noisy, inputs[..., features:]], dim=-1)

    def parts(self) -> Mapping[str, Stateful]:
        """Return all networks, optimizers and the replay buffer."""
        return {
            "actor_critic": self.actor_critic,
            "discriminator": self.discriminator,
            "optimizer": self.optimizer,
            "replay": self.replay,
        }
