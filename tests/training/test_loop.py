import math
from pathlib import Path

import numpy as np
import pytest
import torch

from ssmail.config.experiments import build_spec
from ssmail.config.names import METHODS
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError
from ssmail.training.adversarial import AdversarialLearner, AdversarialTraining
from ssmail.training.curricula import mean_segment_length
from ssmail.training.loop import Divergence, TrainingLoop
from tests.training.conftest import ToySpec

LEARNING = [method for method in METHODS if build_spec(method, "yjunction", "smoke").epochs]


@pytest.fixture(scope="module")
def spec() -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke", ["training.epochs=4"])


def adversarial(loop: TrainingLoop) -> AdversarialLearner:
    assert isinstance(loop.learner, AdversarialLearner)
    return loop.learner


def epochs(loop: TrainingLoop, count: int) -> list[dict[str, float]]:
    records = [loop.run_epoch() for _ in range(count)]
    return [{k: v for k, v in r.items() if k != "seconds"} for r in records]


def assert_same(a: dict[str, float], b: dict[str, float]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name] == b[name] or (math.isnan(a[name]) and math.isnan(b[name])), name


def test_same_seed_same_numbers_other_seed_other_numbers(spec: RunSpec) -> None:
    first, second, other = (epochs(TrainingLoop(spec, s), 2) for s in (0, 0, 1))
    assert first == second
    assert first != other


def check_resumed(spec: RunSpec, state_file: Path) -> None:
    """That a run of four epochs, saved and resumed after two, equals an uninterrupted one."""
    whole = TrainingLoop(spec, 0)
    expected = epochs(whole, 4)
    expected_test, expected_arrays = whole.final_evaluation()

    torch.manual_seed(99)  # nothing may hang on torch's global generator
    broken = TrainingLoop(spec, 0)
    records = epochs(broken, 2)
    torch.save(broken.state_dict(), state_file)
    resumed = TrainingLoop(spec, 0)
    resumed.load_state_dict(torch.load(state_file, weights_only=True))
    records += epochs(resumed, 2)
    assert records == expected
    values, arrays = resumed.final_evaluation()
    assert_same(values, expected_test)
    for name in expected_arrays:
        np.testing.assert_array_equal(arrays[name], expected_arrays[name])

    forgetful = TrainingLoop(spec, 0)  # negative control: a state without the generators is not enough
    state = torch.load(state_file, weights_only=True)
    state["generators"] = forgetful.generators.state_dict()
    forgetful.load_state_dict(state)
    assert epochs(forgetful, 2) != expected[2:]


@pytest.mark.parametrize("method", LEARNING)
def test_a_resumed_run_equals_an_uninterrupted_one(method: str, tmp_path: Path) -> None:
    check_resumed(build_spec(method, "yjunction", "smoke", ["training.epochs=4"]), tmp_path / "state.pt")


@pytest.mark.parametrize(
    "chosen",
    [("ssail",), ("dnri",), ("dnri", "variational.decoder=recurrent", "curriculum.name=none")],
    ids=["ssail", "dnri", "dnri recurrent"],
)
def test_so_does_a_resumed_run_on_recorded_motion(chosen: tuple[str, ...], toy: ToySpec, tmp_path: Path) -> None:
    check_resumed(toy(*chosen, "training.epochs=4"), tmp_path / "state.pt")


def test_the_alpha_range_leaves_weights_and_data_order_alone(spec: RunSpec) -> None:
    """Separate generators: another alpha range changes no initial weight and no generated start."""
    other = build_spec("ssail", "yjunction", "smoke", ["self_supervision.alpha=[0,1]"])
    a, b = TrainingLoop(spec, 3), TrainingLoop(other, 3)
    for one, other_one in zip(adversarial(a).networks(), adversarial(b).networks(), strict=True):
        for p, q in zip(one.parameters(), other_one.parameters(), strict=True):
            assert torch.equal(p, q)
    first, second = (AdversarialTraining([adversarial(loop)]).generate(0.5)[0] for loop in (a, b))
    assert torch.equal(first.states, second.states)


def test_complete_forcing_keeps_the_expert_states(spec: RunSpec) -> None:
    training = AdversarialTraining([adversarial(TrainingLoop(spec, 0))])
    experts, steps = training.experts, training.context.steps
    batch, interventions = training.generate(1.0)
    assert mean_segment_length(interventions[0]) == 1
    torch.testing.assert_close(batch.states[..., :steps, :, :], experts.states[batch.source][..., :steps, :, :])
    free, interventions = training.generate(0.0)
    assert mean_segment_length(interventions[0]) == steps
    assert not torch.allclose(free.states[:, :, steps - 1], experts.states[free.source][:, :, steps - 1])


def test_metrics_and_arrays_have_their_names_and_shapes(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    record = loop.run_epoch()
    promised = {
        "discriminator/loss",
        "discriminator/generated",
        "discriminator/expert",
        "discriminator/self_supervised",
    }
    promised |= {"critic/loss", "actor/loss", "temperature", "entropy", "seconds", "graph/entropy"}
    promised |= {f"curriculum/{m}" for m in ("intervention_frequency", "segment_length", "expected_segment_length")}
    promised |= {f"{s}/{m}" for s in ("train", "validation") for m in ("mode_mse", "on_lane", "lane_balance")}
    assert promised <= record.keys()
    assert record["discriminator/loss"] == pytest.approx(
        sum(record[f"discriminator/{term}"] for term in ("generated", "expert", "self_supervised")), rel=1e-5
    )
    values, arrays = loop.final_evaluation()
    test = spec.data.yjunction.test
    assert arrays["test/rollouts"].shape == (spec.evaluation.samples, test, 50, 3, 2)
    assert arrays["test/lanes"].shape == (2, test, 50, 3, 2)
    for prefix in ("test", "test_mean", "test_last", "test_constant_velocity"):
        assert {
            f"{prefix}/{m}" for m in ("mode_mse", "on_lane", "lane_balance", "min_ade_20", "min_fde_20", "one_step_mse")
        } <= values.keys()


def test_weights_that_are_not_finite_are_a_divergence(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    with torch.no_grad():
        next(adversarial(loop).actor_critic.critic.parameters()).fill_(torch.nan)
    with pytest.raises(Divergence, match="epoch 1"):
        loop.run_epoch()


def test_a_network_reads_time_and_start_only_when_told(spec: RunSpec) -> None:
    sizes = {}
    for time in ("true", "false"):
        for start in ("true", "false"):
            made = build_spec("ssail", "yjunction", "smoke", [f"model.time_input={time}", f"model.start_input={start}"])
            sizes[time, start] = adversarial(TrainingLoop(made, 0)).features.size(4)
    assert sizes == {("true", "true"): 9, ("true", "false"): 5, ("false", "true"): 8, ("false", "false"): 4}


def test_the_best_model_uses_every_mode_if_one_does(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    kept = []
    for loop.epoch, (error, balance) in enumerate(
        [(0.02, 0.0), (0.03, 0.0), (0.05, 0.4), (0.01, 0.1), (0.04, 0.3), (0.06, 0.5)], 1
    ):
        loop._select(*loop.evaluator.rank({"validation/mode_mse": error, "validation/lane_balance": balance}))
        kept.append((loop.improved, loop.best["epoch"]))
    assert kept == [(True, 1), (False, 1), (True, 3), (False, 3), (True, 5), (False, 5)]
    loop._select(*loop.evaluator.rank({"validation/mode_mse": math.nan, "validation/lane_balance": 0.5}))
    assert not loop.improved


@pytest.mark.parametrize("method", METHODS)
def test_every_method_predicts_recorded_motion(method: str, toy: ToySpec) -> None:
    """Shortly trained, it has the metrics that all are compared by."""
    loop = TrainingLoop(toy(method), 0)
    if loop.spec.epochs:
        record = loop.run_epoch()
        assert {"validation/mse", "validation/mse_1", "train/mse", "seconds"} <= record.keys()
        assert all(map(math.isfinite, record.values()))
        assert loop.best["epoch"] == 1
    values, _ = loop.final_evaluation()
    assert {"test/mse_10", "test_noisy/mse_10", "test_constant_velocity/mse_10", "test/diverged"} <= values.keys()
    assert all(map(math.isfinite, values.values()))


def test_a_data_file_of_the_other_environment_is_refused(recorded: Path) -> None:
    with pytest.raises(
        InputError, match=r"mocap\.npz is an expert set of mocap, not of yjunction; train with --env mo"
    ):
        TrainingLoop(build_spec("ssail", "yjunction", "smoke", [f"data.path={recorded}"]), 0)


@pytest.mark.parametrize("method", LEARNING)
def test_every_method_has_the_metrics_that_all_are_compared_by(method: str) -> None:
    loop = TrainingLoop(build_spec(method, "yjunction", "smoke"), 0)
    record = loop.run_epoch()
    assert {"validation/mode_mse", "validation/lane_balance", "train/mode_mse", "seconds"} <= record.keys()
    assert ("curriculum/segment_length" in record) is (loop.spec.curriculum is not None)
    values, _ = loop.final_evaluation()
    unknown = {name for name, value in values.items() if not math.isfinite(value) and not name.endswith("_ade")}
    assert all(name.partition("/")[2].startswith("turn_") for name in unknown)  # of who never turns


@pytest.mark.parametrize("method", ["constant-velocity", "copy-last"])
def test_references_need_no_training_and_know_their_answer(method: str) -> None:
    loop = TrainingLoop(build_spec(method, "yjunction", "smoke"), 0)
    assert loop.spec.epochs == 0
    values, arrays = loop.final_evaluation()
    start, steps = loop.data.test.positions[:, :1], np.arange(50)[None, :, None, None]
    velocity = loop.data.test.velocities[:, :1] if method == "constant-velocity" else 0
    np.testing.assert_allclose(arrays["test/rollouts"][0], start + velocity * steps, rtol=1e-4, atol=1e-4)
    is_constant_velocity = values["test/mode_mse"] == pytest.approx(values["test_constant_velocity/mode_mse"])
    assert is_constant_velocity is (method == "constant-velocity")
    assert (values["test/one_step_mse"] == values["test_constant_velocity/one_step_mse"]) is is_constant_velocity


@pytest.mark.parametrize(
    ("name", "first", "last"), [("none", 49.0, 49.0), ("teacher-forcing", 1.0, 1.0), ("scheduled-sampling", 1.0, 49.0)]
)
@pytest.mark.parametrize("method", ["ssail", "dnri"])
def test_every_generating_method_takes_every_curriculum(method: str, name: str, first: float, last: float) -> None:
    chosen = [f"curriculum.name={name}", "curriculum.rate=1.0", "curriculum.half_life=0.2", "training.epochs=3"]
    loop = TrainingLoop(build_spec(method, "yjunction", "smoke", chosen), 0)
    lengths = [record["curriculum/segment_length"] for record in epochs(loop, 3)]
    assert (lengths[0], lengths[-1]) == (first, last)
