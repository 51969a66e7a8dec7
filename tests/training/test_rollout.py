"""Rolling a policy out: what it reads, where the group is, and what the encoder remembers."""

from typing import Any

import pytest
import torch
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.config.sections import required
from ssmail.data.scaling import Scaling
from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.models.policy import GraphPolicy
from ssmail.training.rollout import PolicyPredictor, Rollout

INTEGRATOR = Integrator(Scaling(-20.0, 45.0, -0.7, 1.1))
B, H, N, D, A, STEPS = 2, 4, 3, 4, 2, 5


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


OBSERVED, NOISE = drawn(B, H, N, D), drawn(B, H + STEPS - 1, N, D, seed=1)
MODEL = required(build_spec("ssail", "yjunction", "smoke").model)
PLAIN = Features(time=False, start=False, steps=50)


class Deaf:
    """A policy that does what it always does, and keeps what it reads: as features, and as velocities."""

    action_size = A

    def __init__(self) -> None:
        self.actions = iter(drawn(STEPS, B, 1, N, A, seed=2))
        self.history: Tensor | None = None
        self.read: list[Tensor] = []
        self.velocities: list[Tensor] = []
        self.actor = self

    def draw_graph_noise(self, batch: int, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        return torch.zeros(batch, 1, 1, 1, 2)

    def encoder(self, x: Tensor, memory: None) -> tuple[None, None]:
        self.history = x
        return None, None

    def graphs(self, x: Tensor, noise: Tensor, memory: Any) -> tuple[None, None, None]:
        self.read.append(x)
        return None, None, None

    def sample(self, x: Tensor, graph: Any, velocity: Tensor, noise: Tensor) -> Tensor:
        self.velocities.append(velocity)
        return next(self.actions)


def deaf(noise: Tensor | None, features: Features = PLAIN, **options: Any) -> tuple[Deaf, Rollout]:
    policy: Any = Deaf()
    return policy, PolicyPredictor(policy, features, INTEGRATOR).rollout(
        OBSERVED, STEPS, torch.Generator(), noise=noise, **options
    )


def test_noise_reaches_what_is_read_and_not_where_the_group_is() -> None:
    (quiet, clean), (noisy, same) = deaf(None), deaf(NOISE)
    assert torch.equal(same.states, clean.states)
    assert torch.equal(clean.states[:, 0], OBSERVED[:, -1])
    torch.testing.assert_close(clean.states[:, 1:], INTEGRATOR.step(clean.states[:, :-1], clean.actions))
    for policy, noise in ((quiet, torch.zeros_like(NOISE)), (noisy, NOISE)):
        read = torch.cat([OBSERVED[:, :-1], clean.states[:, :-1]], dim=1) + noise
        assert policy.history is not None
        torch.testing.assert_close(torch.cat([policy.history, *policy.read], dim=1), read)
        torch.testing.assert_close(torch.cat(policy.velocities, dim=1), read[:, H - 1 :, :, A:])


def test_the_first_state_that_is_read_is_the_first_observed_one_and_steps_count_on_from_it() -> None:
    policy, _ = deaf(NOISE, Features(time=True, start=True, steps=H + STEPS + 1))
    assert policy.history is not None
    x = torch.cat([policy.history, *policy.read], dim=1)
    torch.testing.assert_close(x[..., D + 1 :], (OBSERVED + NOISE[:, :H])[:, :1].expand(-1, H + STEPS - 1, -1, -1))
    steps = 2 * torch.arange(H + STEPS - 1) / (H + STEPS) - 1
    torch.testing.assert_close(x[0, :, 0, D], steps)


def test_an_intervention_puts_the_group_on_the_track_of_the_expert() -> None:
    expert, where = drawn(B, STEPS, N, D, seed=3), torch.zeros(B, STEPS, dtype=torch.bool)
    where[0, 2] = True
    _, free = deaf(None)
    policy, put = deaf(NOISE, expert=expert, interventions=where)
    assert torch.equal(put.states[0, 2], expert[0, 2])
    torch.testing.assert_close(policy.read[2][0, 0], expert[0, 2] + NOISE[0, H + 1])
    assert torch.equal(put.states[1], free.states[1])
    assert torch.equal(put.states[0, :2], free.states[0, :2])
    assert not torch.equal(put.states[0, 3], free.states[0, 3])


class Recording(GraphPolicy):
    """Keeps the logits of its graphs."""

    def graphs(self, *given: Any) -> tuple[Tensor, Tensor, Any]:
        graphs, logits, memory = super().graphs(*given)
        self.kept = [*getattr(self, "kept", []), logits]
        return graphs, logits, memory


def acting(
    observed: Tensor, noise: Tensor | None, seed: int = 0, edge_types: int = 2, **options: Any
) -> tuple[Recording, Rollout]:
    """A policy with weights that matter, rolled out from what was observed."""
    torch.manual_seed(0)
    policy = Recording(D, A, MODEL.model_copy(update={"edge_types": edge_types}))
    for p in policy.parameters():
        p.data += 0.3 * torch.randn_like(p)
    draw = torch.Generator().manual_seed(seed)
    return policy, PolicyPredictor(policy, PLAIN, INTEGRATOR).rollout(observed, STEPS, draw, noise=noise, **options)


@pytest.mark.parametrize("noise", [None, NOISE], ids=["clean", "noisy"])
@pytest.mark.parametrize("at_once", [10, 2])
def test_the_encoder_remembers_what_was_observed_as_if_it_had_read_all_in_one_pass(
    noise: Tensor | None, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ssmail.training.rollout.ENCODER_CHUNK", at_once)
    policy, made = acting(OBSERVED, noise)
    read = torch.cat([OBSERVED[:, :-1], made.states[:, :-1]], dim=1) + (0 if noise is None else noise)
    with torch.no_grad():
        expected = policy.encoder(read)[0][:, H - 1 :]
        forgetful = policy.encoder(read[:, H - 1 :])[0]  # negative control
    torch.testing.assert_close(torch.cat(policy.kept[-STEPS:], dim=1), expected)
    assert not torch.allclose(expected, forgetful, atol=1e-3)


def test_a_rollout_from_one_observed_state_has_no_history() -> None:
    policy, made = acting(OBSERVED[:, -1:], None)
    with torch.no_grad():
        torch.testing.assert_close(torch.cat(policy.kept, dim=1), policy.encoder(made.states[:, :-1])[0])


def test_no_noise_is_noise_of_nothing() -> None:
    clean, nothing, noisy = (acting(OBSERVED, noise)[1] for noise in (None, torch.zeros_like(NOISE), 0.1 * NOISE))
    assert torch.equal(clean.states, nothing.states)
    assert torch.equal(clean.actions, nothing.actions)
    assert not torch.allclose(clean.actions, noisy.actions)


def test_mean_actions_depend_on_the_draw_of_the_graph_alone() -> None:
    """With one type of edge there is nothing to draw of a graph."""
    for edge_types, deterministic, alike in ((1, True, True), (1, False, False), (2, True, False)):
        made = [acting(OBSERVED, None, seed, edge_types, deterministic=deterministic)[1] for seed in range(4)]
        assert all(torch.equal(other.states, made[0].states) for other in made) is alike


def test_several_samples_of_a_group_are_rollouts_of_as_many_copies() -> None:
    """They share what the policy has observed, and nothing of what is drawn."""
    _, shared = acting(OBSERVED, None, samples=3)
    _, copies = acting(OBSERVED.repeat(3, 1, 1, 1), None)
    torch.testing.assert_close(shared.states, copies.states)
    torch.testing.assert_close(shared.actions, copies.actions)
    assert not torch.allclose(shared.actions[:B], shared.actions[B : 2 * B])
