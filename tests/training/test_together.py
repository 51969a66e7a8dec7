"""Seeds of one spec trained at once: every number of each seed is the one it has when it is trained alone.

With a batch of 16, as in all profiles but smoke: a batch that does not fill the processor's vectors may be rounded in
another way (`ssmail.training.stacking.ALIGNED`).
"""

from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.envs.integrator import IntegratorOfSeeds
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.checkpoint import load_checkpoint, save_checkpoint
from ssmail.training.loop import Divergence, TrainingLoop
from ssmail.training.seeding import Generators
from tests.execution.recorded import plain

SEEDS, EPOCHS = (0, 1, 2), 2
WAYS = {
    "ssail": ("ssail",),
    "gail": ("gail",),
    "wail with penalty": ("wail", "wasserstein.constraint=penalty"),
    "wail with clipping": ("wail", "wasserstein.constraint=clipping"),
    "ssail with all that is optional": (
        "ssail",
        "sac.expansion_steps=2",
        "sac.average=0.01",
        "model.discriminator_waves=[1.0,4.0]",
        "model.discriminator_hidden=16",
        "model.graph_noise=edge",
        "self_supervision.pairing=assignment",
    ),
    "ssail whose actor starts late": ("ssail", "sac.actor_start=0.25", "adversarial.past_share=1.0"),
    "ssail, each seed on data of its own": ("ssail", "data.yjunction.seed=null"),
    "wail, each seed on data of its own": ("wail", "data.yjunction.seed=null", "sac.expansion_steps=1"),
    "ssail whose networks are fitted to data of its own": (
        "ssail",
        "data.yjunction.seed=null",
        "model.standardize=true",
    ),
}


def spec_of(method: str, *overrides: str) -> RunSpec:
    return build_spec(method, "yjunction", "smoke", ["training.epochs=4", "training.batch=16", *overrides])


def loops(spec: RunSpec, seeds: Sequence[int] = SEEDS) -> list[TrainingLoop]:
    return [TrainingLoop(spec, seed) for seed in seeds]


def numbers(outcome: dict[str, float] | Exception) -> Any:
    """Of an epoch, without the time that it took, as text, so that NaN equals NaN."""
    if isinstance(outcome, Exception):
        return repr(outcome)
    return {name: repr(value) for name, value in outcome.items() if name != "seconds"}


def together(made: Sequence[TrainingLoop], epochs: int = EPOCHS) -> list[Any]:
    """Train at once; the numbers of each seed, epoch by epoch, with its state after the last."""
    trained = [[numbers(outcome) for outcome in TrainingLoop.run_epochs(made)] for _ in range(epochs)]
    return [(of_seed, plain(loop.state_dict())) for of_seed, loop in zip(zip(*trained, strict=True), made, strict=True)]


@cache
def _single(spec: RunSpec, seed: int) -> tuple[TrainingLoop, list[Any]]:
    return TrainingLoop(spec, seed), []


def alone(spec: RunSpec, seeds: Sequence[int] = SEEDS, epochs: int = EPOCHS) -> list[Any]:
    """What `together` returns for seeds that are each trained alone; computed once for all tests."""
    results = []
    for seed in seeds:
        loop, known = _single(spec, seed)
        while len(known) < epochs:
            ((metrics,), state), *_ = together([loop], 1)
            known.append((metrics, state))
        results.append((tuple(metrics for metrics, _ in known[:epochs]), known[epochs - 1][1]))
    return results


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_seeds_trained_together_are_those_trained_alone_to_the_last_bit(way: tuple[str, ...]) -> None:
    spec = spec_of(*way)
    expected = alone(spec)
    assert together(loops(spec)) == expected
    metrics, states = zip(*expected, strict=True)
    assert metrics[0] != metrics[1] != metrics[2]  # negative control: seeds differ in their numbers and states
    assert states[0] != states[1] != states[2]


def test_which_seeds_share_a_process_and_in_which_order_changes_nothing() -> None:
    spec = spec_of("ssail")
    zero, one, two = alone(spec)
    assert together(loops(spec, (2, 0))) == [two, zero]
    assert together(loops(spec, (1, 2))) == [one, two]


def test_methods_without_a_common_training_are_trained_one_after_the_other() -> None:
    spec = spec_of("bc")
    assert together(loops(spec)) == alone(spec)


def test_each_seed_has_data_of_its_own_where_the_data_have_no_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = spec_of("ssail", "data.yjunction.seed=null")
    own = loops(spec)
    assert len({loop.dataset_hash for loop in own}) == len(own)
    assert len({loop.scaling for loop in own}) == len(own)
    shared = loops(spec_of("ssail", "data.yjunction.seed=1"))
    assert {loop.dataset_hash for loop in shared} == {own[1].dataset_hash}
    # negative control: with the dynamics of the first, the others have other numbers
    of = IntegratorOfSeeds.of
    monkeypatch.setattr(IntegratorOfSeeds, "of", lambda each, like: of([each[0]] * len(each), like))
    zero, one, two = together(own)
    expected = alone(spec)
    assert zero == expected[0]
    assert one != expected[1]
    assert two != expected[2]


def poisoned(network: nn.Module) -> None:
    with torch.no_grad():
        next(network.parameters()).view(-1)[0] = torch.nan


@pytest.mark.parametrize("part", ["policy", "critic", "discriminator"])
def test_a_seed_that_diverges_leaves_the_others_numbers_unchanged(part: str) -> None:
    """Then the others go on without it."""
    spec = spec_of(*WAYS["ssail with all that is optional"])
    expected = alone(spec)
    made = loops(spec)
    networks = dict(zip(("policy", "critic", "discriminator"), made[1].learner.networks(), strict=True))
    poisoned(networks[part])
    zero, diverged, two = TrainingLoop.run_epochs(made)
    assert isinstance(diverged, Divergence)
    assert str(diverged) == "weights became NaN or infinite in epoch 1"
    assert made[1].epoch == 0
    assert [numbers(zero), numbers(two)] == [expected[0][0][0], expected[2][0][0]]
    ((last_of_zero,), state_of_zero), ((last_of_two,), state_of_two) = together([made[0], made[2]], 1)
    assert [(last_of_zero, state_of_zero), (last_of_two, state_of_two)] == [
        (metrics[1], state) for metrics, state in (expected[0], expected[2])
    ]


def resumed(loop: TrainingLoop, file: Path) -> TrainingLoop:
    """A new loop that has read the state of another one of its spec and seed from a file."""
    save_checkpoint(file, loop.state_dict())
    seed = SEEDS[[Generators(s).seeds for s in SEEDS].index(loop.generators.seeds)]
    fresh = TrainingLoop(loop.spec, seed)
    fresh.load_state_dict(load_checkpoint(file))
    return fresh


@pytest.mark.parametrize("way", ["ssail", "ssail with all that is optional"])
def test_seeds_interrupted_at_different_epochs_catch_up_with_equal_numbers(way: str, tmp_path: Path) -> None:
    """Seeds 0 and 1 together for an epoch, seed 0 alone for a second; both interrupted; seed 1 and a new seed 2 catch
    up; then all three at once.
    """
    spec = spec_of(*WAYS[way])
    expected = alone(spec, epochs=3)
    zero, one = made = loops(spec, (0, 1))
    first = together(made, 1)
    second_of_zero = together([zero], 1)
    zero, one = (resumed(loop, tmp_path / "last.pt") for loop in (zero, one))
    two = TrainingLoop(spec, 2)
    first_of_two = together([two], 1)
    behind = together([one, two], 1)
    final = together([zero, one, two], 1)
    pieces = [(first[0], second_of_zero[0]), (first[1], behind[0]), (first_of_two[0], behind[1])]
    for (whole, state), before, (last, state_at_end) in zip(expected, pieces, final, strict=True):
        assert (*(metrics for piece in before for metrics in piece[0]), *last) == whole
        assert state_at_end == state


def test_a_state_without_the_moments_would_give_other_numbers(tmp_path: Path) -> None:
    """Negative control of the comparison above."""
    spec = spec_of("ssail")
    expected = alone(spec)
    made = loops(spec)
    together(made, 1)
    forgetful = []
    for seed, loop in zip(SEEDS, made, strict=True):
        state = deepcopy(loop.state_dict())
        for optimizer in (state["learner"]["optimizer"], *state["learner"]["actor_critic"]["optimizers"].values()):
            for moments in optimizer["state"].values():
                moments["exp_avg_sq"] = torch.ones_like(moments["exp_avg_sq"])
        fresh = TrainingLoop(spec, seed)
        fresh.load_state_dict(state)
        forgetful.append(fresh)
    for (_, state), (_, other) in zip(expected, together(forgetful, 1), strict=True):
        assert state["learner"]["discriminator"] != other["learner"]["discriminator"]


def test_a_checkpoint_holds_its_seed_alone(tmp_path: Path) -> None:
    """Byte by byte that of the seed trained alone, although its weights are a part of what the seeds share."""
    spec = spec_of(*WAYS["ssail with all that is optional"])
    made, single = loops(spec), TrainingLoop(spec, 1)
    together(made, 1)
    together([single], 1)
    for name, loop in (("one", made[1]), ("same", single), ("other", made[0])):
        save_checkpoint(tmp_path / name, loop.state_dict())
    one, same, other = ((tmp_path / name).read_bytes() for name in ("one", "same", "other"))
    assert one == same != other


def test_a_seed_that_was_trained_with_others_is_whole() -> None:
    """Its predictor, its best weights and its learner can be used, and go on, without the others."""
    spec = spec_of("ssail")
    made = loops(spec)
    together(made, 1)
    before = plain(made[1].state_dict())
    del made[0], made[1]
    (one,) = made
    assert isinstance(one.learner, AdversarialLearner)
    assert plain(one.state_dict()) == before
    ((_, last), state) = alone(spec)[1]
    assert numbers(one.run_epoch()) == last
    assert plain(one.state_dict()) == state
    values, arrays = one.final_evaluation()
    assert values["best_epoch"] in (1.0, 2.0)
    assert arrays["test/rollouts"].shape[0] == spec.evaluation.samples
