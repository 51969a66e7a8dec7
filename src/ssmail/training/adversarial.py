"""Adversarial learning (Alg. 1): a discriminator, and a soft actor-critic that maximizes the reward made of it.

ssail, gail and wail differ in one row of OBJECTIVES, and in whether tau_alpha joins the batches (self-supervision,
section 3.1.2). `AdversarialLearner` is the state of one seed, and `AdversarialTraining` the algorithm, on the states of
one or more seeds at once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ssmail.config.sections import AdversarialSpec, SelfSupervisionSpec, required
from ssmail.config.user_functions import load_label
from ssmail.config.value_types import Pairing
from ssmail.losses import Terms
from ssmail.losses.adversarial import (
    gail_loss,
    gail_probability,
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
from ssmail.models.features import Waves
from ssmail.training.actor_critic import ActorCritic, SoftActorCritic, at_steps
from ssmail.training.agent_numbers import replay_buffers, replay_name
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import Stateful
from ssmail.training.curricula import curriculum_metrics, draw_interventions, intervention_frequency
from ssmail.training.learner import LearnerContext, experts_of_seeds
from ssmail.training.optimization import LearningRateSchedule, add_noise
from ssmail.training.rollout import PolicyPredictor
from ssmail.training.seeding import GeneratorsOfSeeds, drawn
from ssmail.training.stacking import StackedAdam, fixed, stacked_modules


@dataclass(frozen=True)
class AdversarialObjective:
    """The two functions that define a method.

    loss: the discriminator's loss from its outputs on tau_G and tau_E (and, for ssail, on tau_alpha, its labels, and
    the weight of that term).
    reward: the actor-critic's reward from the discriminator's output.
    """

    loss: Callable[..., tuple[Tensor, Terms]]
    reward: Callable[[Tensor], Tensor]

    @classmethod
    def of(cls, method: str, spec: AdversarialSpec) -> "AdversarialObjective":
        """Return the objective of a method, with the reward that the spec asks for."""
        own = OBJECTIVES[method]
        return own if spec.reward == "own" else replace(own, reward=gail_probability)


OBJECTIVES = {
    "ssail": AdversarialObjective(ssail_loss, ssail_reward),  # Eq. 3
    "gail": AdversarialObjective(gail_loss, gail_reward),  # Eq. 1
    "wail": AdversarialObjective(wail_loss, wail_reward),  # Eq. 2
}


class AdversarialLearner:
    """The networks, optimizers and replay buffers of one seed."""

    def __init__(self, context: LearnerContext) -> None:
        spec = context.spec
        model, sac = required(spec.model), required(spec.sac)
        self.adversarial, self.training = required(spec.adversarial), required(spec.training)
        self.context, self.objective = context, AdversarialObjective.of(spec.method, self.adversarial)
        self.generators = context.generators
        self.label = None
        if spec.self_supervision:
            self.label = checked_label(spec.self_supervision, load_label(spec.self_supervision.label))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.generators.seeds["weights"])
            self.predictor = PolicyPredictor.create(model, context.by_number, context.integrator)
            self.features = self.predictor.features
            inputs = self.features.size(context.experts.states.shape[-1]) + context.experts.actions.shape[-1]
            critic = TwinCritic(inputs, model).to(context.device)
            waves = Waves(context.experts.actions.shape[-1], model.discriminator_waves)
            hidden = model.discriminator_hidden or model.hidden
            state_size = context.experts.states.shape[-1]
            seen = None if model.discriminator_velocities else self.features.without_velocities(state_size)
            self.discriminator = Discriminator(inputs, hidden, waves, seen).to(context.device)
        self.actor_critic = ActorCritic(sac, self.predictor, critic, self.generators)
        if self.actor_critic.averaged is not None:
            self.predictor = replace(self.predictor, model=self.actor_critic.averaged)
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
        self.replays = replay_buffers(self.adversarial.replay, context.by_number)

    def networks(self) -> list[nn.Module]:
        """Return policy, critics and discriminator."""
        return [self.actor_critic.policy, self.actor_critic.critic, self.discriminator]

    def run_epoch(self, epoch: int) -> dict[str, float]:
        """Train this seed alone; see `AdversarialTraining.run_epoch`."""
        return self.run_epochs([self], epoch)[0]

    @staticmethod
    def run_epochs(learners: "Sequence[AdversarialLearner]", epoch: int) -> list[dict[str, float]]:
        """Train seeds of one spec at once; see `AdversarialTraining.run_epoch`."""
        return AdversarialTraining(learners).run_epoch(epoch)

    def reward(self, x: Tensor, actions: Tensor) -> Tensor:
        """Return the rewards (..., N) of features x (..., N, F) and actions (..., N, A), with the current networks."""
        return scaled_reward(self.adversarial, self.objective.reward(self.discriminator(x, actions)))

    def agent_reward(self, agent: int, own: Tensor, x: Tensor, actions: Tensor) -> Tensor:
        """Return the rewards (...) of one agent as `reward` does, with features `own` (..., F) for its row of x.

        Leading axes broadcast; see `Discriminator.score_agent`.
        """
        score = self.discriminator.score_agent(agent, own, x, actions)
        return scaled_reward(self.adversarial, self.objective.reward(score))

    def parts(self) -> Mapping[str, Stateful]:
        """Return all networks, optimizers and the replay buffers."""
        return {
            "actor_critic": self.actor_critic,
            "discriminator": self.discriminator,
            "optimizer": self.optimizer,
            **self.replays,
        }


def scaled_reward(spec: AdversarialSpec, reward: Tensor) -> Tensor:
    """Return a method's reward, scaled by adversarial.reward_scale and clipped to adversarial.reward_limit."""
    scaled = spec.reward_scale * reward
    return scaled if spec.reward_limit is None else scaled.clamp(-spec.reward_limit, spec.reward_limit)


def input_noise(spec: AdversarialSpec, epoch: int, epochs: int) -> float:
    """Return the standard deviation of D's input noise in epoch 0 .. epochs - 1.

    It is adversarial.input_noise until the fraction input_noise_start of the epochs, then falls geometrically to
    input_noise_final of it.
    """
    passed = (epoch / max(epochs - 1, 1) - spec.input_noise_start) / (1 - spec.input_noise_start)
    falling: float = spec.input_noise_final ** max(passed, 0.0)
    return spec.input_noise * falling


class AdversarialTraining:
    """Alternates discriminator steps and soft actor-critic steps on trajectories from replay buffers.

    It trains the networks of S seeds of one spec at once. Every seed draws from its own generators, and its numbers are
    those of the seed trained alone. Trajectories and networks have an axis S in front.
    """

    def __init__(self, seeds: Sequence[AdversarialLearner]) -> None:
        first = seeds[0]
        spec, context = first.context.spec, first.context
        self.seeds, self.generators = seeds, GeneratorsOfSeeds([seed.generators for seed in seeds])
        self.context, self.objective, self.label, self.features = context, first.objective, first.label, first.features
        self.adversarial, self.training = first.adversarial, first.training
        self.curriculum = required(spec.curriculum)
        self.supervision, self.wasserstein = spec.self_supervision, spec.wasserstein
        self.by_number = experts_of_seeds([seed.context for seed in seeds])
        self.experts, self.device = self.by_number[0], context.device  # the experts of this update's number of agents
        self.input_noise, self.expansion_steps = self.adversarial.input_noise, 0  # of this epoch
        self.actor_critic = SoftActorCritic([seed.actor_critic for seed in seeds], self.training.gradient_clip)
        self.predictor = PolicyPredictor(self.actor_critic.policy, first.features, self.actor_critic.integrator)
        self.discriminator, block = stacked_modules([seed.discriminator for seed in seeds])
        self.fixed_discriminator = fixed(self.discriminator)
        self.optimizer = StackedAdam(
            list(self.discriminator.parameters()),
            block,
            [seed.optimizer for seed in seeds],
            self.training.gradient_clip,
        )

    def run_epoch(self, epoch: int) -> list[dict[str, float]]:
        """Roll out once under the curriculum, then take training.updates updates (Alg. 1).

        Returns the metrics of each seed for epoch 0 .. epochs - 1.
        """
        frequency = intervention_frequency(self.curriculum, epoch, self.training.epochs)
        for seed in self.seeds:
            seed.schedule.set(epoch)
        # tau_G from the current policy, into the replay buffers.
        turns = self.context.turns(epoch, self.training.updates)
        latest, replay, interventions = {}, {}, []
        for turn in sorted(set(turns)):
            self.experts = self.by_number[turn]
            share = turns.count(turn) / len(turns)
            latest[turn], made = self.generate(frequency, max(1, round(share * self.adversarial.rollouts)))
            replay[turn] = self._remember(latest[turn])
            interventions.append(made)
        self.input_noise = input_noise(self.adversarial, epoch, self.training.epochs)
        # Warm-up: until sac.actor_start, the fraction of all epochs, only the critics and the discriminator learn.
        sac, epochs = self.actor_critic.spec, self.training.epochs
        actor_learns = epoch >= (sac.actor_start or 0) * epochs
        self.expansion_steps = sac.expansion_steps if epoch >= sac.expansion_start * epochs else 0
        logs = []
        for turn in turns:
            self.experts = self.by_number[turn]
            logs.append(self.update(latest[turn], replay[turn], actor_learns=actor_learns))
        means = {name: torch.stack([log[name] for log in logs]).double().mean(dim=0).tolist() for name in logs[0]}
        return [
            {name: values[s] for name, values in means.items()}
            | curriculum_metrics(frequency, [made[s] for made in interventions])
            for s in range(len(self.seeds))
        ]

    def generate(self, frequency: float, count: int | None = None) -> tuple[Batch, Tensor]:
        """Generate tau_G from random training starts, and return it with the interventions (S, B, T).

        frequency: the curriculum's probability of an intervention per step (trajectory forcing, section 3.3). count: of
        trajectories for each seed, adversarial.rollouts by default.
        """
        count, steps = count or self.adversarial.rollouts, self.context.steps
        starts = self.experts.draw(count, self.generators["data"])
        interventions = drawn(self.generators["curriculum"], lambda g: draw_interventions(count, steps, frequency, g))
        made = self.predictor.rollout(
            starts.states[:, :, :1],
            steps,
            self.generators["policy"],
            expert=starts.states,
            interventions=interventions.to(self.device) if frequency > 0 else None,
        )
        return Batch(made.states, made.actions, starts.source), interventions

    def _remember(self, latest: Batch) -> Batch:
        """Add tau_G to the replay buffers of its number of agents, and return all that they hold."""
        name = replay_name(latest.states.shape[-2], self.context.by_number)
        for seed, made in zip(self.seeds, latest.of_each(), strict=True):
            seed.replays[name].add(made)
        return Batch.of_seeds([seed.replays[name].trajectories for seed in self.seeds])

    def update(self, latest: Batch, replay: Batch, *, actor_learns: bool = True) -> dict[str, Tensor]:
        """Take adversarial.updates discriminator steps, then one SAC step (two time scales).

        Returns mean losses, (S,) each.
        """
        logs = [self._update_discriminator(latest, replay) for _ in range(self.adversarial.updates)]
        batch = self._actor_batch(replay)
        steps = self._pick_steps(batch.actions.shape[2])
        values = self.actor_critic.update(
            batch, steps, self.reward, expansion_steps=self.expansion_steps, actor_learns=actor_learns
        )
        means = {name: torch.stack([log[name] for log in logs]).mean(dim=0) for name in logs[0]}
        return means | {name: value.detach() for name, value in values.items()}

    def _update_discriminator(self, latest: Batch, replay: Batch) -> dict[str, Tensor]:
        # tau_G: fresh rollouts, and a share of past ones from the replay buffer. tau_E: the expert's.
        b, data = self.training.batch, self.generators["data"]
        past = round(b * self.adversarial.past_share)
        parts = [latest.draw(b - past, data)] if past < b else []
        if past:
            parts.append(replay.draw(past, data))
        batches = [Batch.concatenate(parts), self.experts.draw(b, data)]
        # tau_alpha and its labels (self-supervision).
        targets: tuple[Tensor | float, ...] = ()
        if self.supervision and self.label and self.supervision.discriminator_weight:
            mixed, alpha = self._mixed(batches[0], self.supervision, self.supervision.pairing)
            batches.append(mixed)
            targets = torch.stack([self.label(part) for part in alpha]), self.supervision.discriminator_weight
        # One pass of D over all parts at the same random time steps; its outputs are then split again (Eq. 3).
        everything = Batch.concatenate(batches)
        chosen = self._pick_steps(everything.actions.shape[2])
        states = everything.states[:, :, :-1]
        x = at_steps(self.features(states, states[:, :, 0]), chosen)
        x = self._add_input_noise(x, states.shape[-1])
        actions = self._add_input_noise(self.features.normalize_actions(at_steps(everything.actions, chosen)))
        outputs = self.discriminator(x, actions).chunk(len(batches), dim=1)
        loss, terms = self.objective.loss(*outputs, *targets)
        # wail bounds D's slope by a gradient penalty, or by clipping its weights.
        if self.wasserstein and self.wasserstein.constraint == "penalty":
            (x_g, x_e), (a_g, a_e) = x.chunk(2, dim=1), actions.chunk(2, dim=1)
            weight = drawn(self.generators["data"], lambda g: torch.rand(x_g.shape[1:3], generator=g)).to(self.device)
            penalty = gradient_penalty(self.discriminator, (x_g, a_g), (x_e, a_e), weight)
            terms["penalty"] = self.wasserstein.penalty * penalty
            loss = loss + terms["penalty"]
        self.optimizer.step(loss)
        if self.wasserstein and self.wasserstein.constraint == "clipping":
            with torch.no_grad():
                for parameter in self.discriminator.parameters():
                    parameter.clamp_(-self.wasserstein.clip, self.wasserstein.clip)
        return {f"discriminator/{name}": value.detach() for name, value in {"loss": loss, **terms}.items()}

    def _actor_batch(self, replay: Batch) -> Batch:
        """Draw the actor-critic's batch from the replay buffers.

        With self-supervision, tau_alpha replaces the first self_supervision.actor_share of tau_G: the dynamics are
        affine, so an off-policy critic can learn from the mix (section 3.1.2).
        """
        generated = replay.draw(self.training.batch, self.generators["data"])
        if not self.supervision:
            return generated
        first, others = generated.split(round(len(generated) * self.supervision.actor_share))
        mixed, _ = self._mixed(first, self.supervision, self.supervision.actor_pairing)
        return Batch.concatenate([mixed, others])

    def reward(self, x: Tensor, actions: Tensor) -> Tensor:
        """Return the rewards (S, B, T, N) of features x (S, B, T, N, F) and actions (S, B, T, N, A)."""
        return scaled_reward(self.adversarial, self.objective.reward(self.fixed_discriminator(x, actions)))

    def _pair(self, generated: Batch, pairing: Pairing) -> Batch:
        """Return the expert trajectory with which to mix each generated one."""
        if pairing == "start":
            return self.experts.at(generated.source)
        if pairing == "nearest":
            own = self.experts.states
            of_each = own if self.experts.source.dim() > 1 else own.expand(len(self.seeds), *own.shape)
            found = [nearest(made, experts) for made, experts in zip(generated.states, of_each, strict=True)]
            return self.experts.at(torch.stack(found))
        candidates = self.experts.draw(len(generated), self.generators["data"]).of_each()
        pairs = zip(generated.states, candidates, strict=True)
        return Batch.of_seeds([found[assignment(made, found.states)] for made, found in pairs])

    def _mixed(self, generated: Batch, supervision: SelfSupervisionSpec, pairing: Pairing) -> tuple[Batch, Tensor]:
        """Mix a batch of tau_G with its expert partners: tau_alpha and alpha (S, B), section 3.1."""
        pieces = supervision.alpha_pieces
        alpha = drawn(self.generators["alpha"], lambda g: sample_alpha(len(generated), pieces, g)).to(self.device)
        expert = self._pair(generated, pairing)
        states, actions = mix(generated.states, expert.states, alpha), mix(generated.actions, expert.actions, alpha)
        return Batch(states, actions, generated.source), alpha

    def _pick_steps(self, steps: int) -> Tensor:
        """Draw the time steps (S, C) of an update in random order: all, or adversarial.time_steps of them."""
        order = drawn(self.generators["data"], lambda g: torch.randperm(steps, generator=g))
        return order[:, : self.adversarial.time_steps].to(self.device)

    def _add_input_noise(self, inputs: Tensor, features: int | None = None) -> Tensor:
        """Add Gaussian noise to the first `features` inputs (all by default), so that D ignores jitter."""
        noisy = add_noise(inputs[..., :features], self.input_noise, self.generators["data"])
        return noisy if features is None else torch.cat([noisy, inputs[..., features:]], dim=-1)
