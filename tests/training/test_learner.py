"""What every method's predictor promises (`ssmail.training.learner.Predictor`), untrained, on recorded motion."""

import pytest
import torch
from torch import Tensor

from ssmail.config.names import METHODS
from ssmail.training.learner import Predictor
from ssmail.training.loop import TrainingLoop
from tests.training.conftest import ToySpec

H, STEPS = 4, 6
RECURRENT = "variational.decoder=recurrent"
every_method = pytest.mark.parametrize("method", [*METHODS, "nri recurrent", "dnri recurrent"])


@pytest.fixture(scope="module")
def loops() -> dict[str, TrainingLoop]:
    return {}


@pytest.fixture
def loop(method: str, loops: dict[str, TrainingLoop], toy: ToySpec) -> TrainingLoop:
    """Away from the untrained networks that are close to constant velocity."""
    if method not in loops:
        name, _, decoder = method.partition(" ")
        made = TrainingLoop(toy(name, *([RECURRENT] if decoder else [])), 0)
        torch.manual_seed(0)
        for network in made.learner.networks():
            for p in network.parameters():
                p.data += 0.2 * torch.randn_like(p)
        loops[method] = made
    return loops[method]


def states_of(loop: TrainingLoop) -> Tensor:
    return loop.experts.states[:3, :H]


def free_run(loop: TrainingLoop, observed: Tensor | None = None, noise: Tensor | None = None) -> Tensor:
    predictor: Predictor = loop.learner.predictor
    observed = states_of(loop) if observed is None else observed
    draw = torch.Generator().manual_seed(0)
    return predictor.free_run(observed, STEPS, draw, deterministic=True, noise=noise)


def noise_for(loop: TrainingLoop, std: float) -> Tensor:
    b, h, n, d = states_of(loop).shape
    return std * torch.randn(b, h + STEPS - 1, n, d, generator=torch.Generator().manual_seed(1))


@every_method
def test_predictions_begin_with_the_last_observed_state_and_obey_the_dynamics(loop: TrainingLoop) -> None:
    """Copies of the last state excepted, which claim a velocity and do not move."""
    for noise in (None, noise_for(loop, 0.2)):
        made = free_run(loop, noise=noise)
        assert made.shape == (3, STEPS + 1, 5, 6)
        assert torch.equal(made[:, 0], states_of(loop)[:, -1])
        integrated = loop.integrator.step(made[:, :-1], made[:, 1:, :, 3:])
        assert torch.allclose(made[:, 1:], integrated, atol=1e-6) is (loop.spec.method != "copy-last")


@every_method
def test_no_noise_is_noise_of_nothing_and_noise_changes_predictions(loop: TrainingLoop) -> None:
    clean = free_run(loop)
    assert torch.equal(free_run(loop, noise=noise_for(loop, 0)), clean)
    assert not torch.allclose(free_run(loop, noise=noise_for(loop, 0.2))[:, 1:], clean[:, 1:], atol=1e-4)


@every_method
def test_who_has_a_memory_reads_what_was_observed_before(loop: TrainingLoop) -> None:
    """Graph policies and recurrent decoders; the references read the last state alone. (Of what a decoder without
    memory has not read itself only the graph is left, which may be the same.)
    """
    other = states_of(loop).clone()
    other[:, : H - 1] = other[:, : H - 1].flip(0) + 1
    same = torch.equal(free_run(loop, other), free_run(loop))
    if loop.spec.method in ("constant-velocity", "copy-last"):
        assert same
    elif loop.spec.variational is None or loop.spec.variational.decoder == "recurrent":
        assert not same


@every_method
def test_one_step_predictions_read_the_past_only(loop: TrainingLoop) -> None:
    states = loop.experts.states[:3]
    later = states.clone()
    later[:, 5:] += 0.5
    made, other = (loop.learner.predictor.one_step(s, torch.Generator().manual_seed(0)) for s in (states, later))
    assert made.shape == states[:, 1:].shape
    torch.testing.assert_close(made[:, :5], other[:, :5])
    assert not torch.allclose(made[:, 5:], other[:, 5:])


@every_method
def test_weights_are_saved_and_read_back(loop: TrainingLoop, toy: ToySpec) -> None:
    fresh = TrainingLoop(loop.spec, 1)
    before = free_run(fresh)
    fresh.learner.predictor.model.load_state_dict(loop.learner.predictor.model.state_dict())
    assert torch.equal(free_run(fresh), free_run(loop))
    assert torch.equal(before, free_run(loop)) is (not loop.spec.epochs)  # other weights, other motion
