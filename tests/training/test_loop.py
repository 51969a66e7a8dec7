import math
from pathlib import Path

import numpy as np
import pytest
import torch

from ssmail.experiments import build_spec
from ssmail.spec import RunSpec
from ssmail.training.loop import Divergence, TrainingLoop


@pytest.fixture(scope="module")
def spec() -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke", ["training.epochs=4", "training.policy_average=0.9"])


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


def test_a_resumed_run_equals_an_uninterrupted_one(spec: RunSpec, tmp_path: Path) -> None:
    whole = TrainingLoop(spec, 0)
    expected = epochs(whole, 4)
    expected_test, expected_arrays = whole.final_evaluation()

    torch.manual_seed(99)  # nothing may hang on torch's global generator
    broken = TrainingLoop(spec, 0)
    records = epochs(broken, 2)
    torch.save(broken.state_dict(), tmp_path / "state.pt")
    resumed = TrainingLoop(spec, 0)
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    records += epochs(resumed, 2)
    assert records == expected
    values, arrays = resumed.final_evaluation()
    assert_same(values, expected_test)
    for name in expected_arrays:
        np.testing.assert_array_equal(arrays[name], expected_arrays[name])

    forgetful = TrainingLoop(spec, 0)  # negative control: a state without the generators is not enough
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    state["generators"] = forgetful.generators.state_dict()
    forgetful.load_state_dict(state)
    assert epochs(forgetful, 2) != expected[2:]


def test_the_alpha_range_leaves_weights_and_data_order_alone(spec: RunSpec) -> None:
    """Separate generators: another alpha range changes no initial weight and no generated start."""
    other = build_spec("ssail", "yjunction", "smoke", ["adversarial.alpha_low=0.0"])
    a, b = TrainingLoop(spec, 3), TrainingLoop(other, 3)
    for p, q in zip(a.learner.policy.parameters(), b.learner.policy.parameters(), strict=True):
        assert torch.equal(p, q)
    assert torch.equal(a._generate(0.5)[0].states, b._generate(0.5)[0].states)


def test_complete_forcing_keeps_the_expert_states(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    batch, segment = loop._generate(1.0)
    assert segment == 1
    experts = loop.experts.states[batch.source]
    torch.testing.assert_close(batch.states[:, : loop.steps], experts[:, : loop.steps])
    free, segment = loop._generate(0.0)
    assert segment == loop.steps
    assert not torch.allclose(free.states[:, loop.steps - 1], loop.experts.states[free.source][:, loop.steps - 1])


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
    promised |= {"curriculum/intervention_frequency", "curriculum/segment_length"}
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
            f"{prefix}/{m}" for m in ("mode_mse", "on_lane", "lane_balance", "min_ade_20", "min_fde_20")
        } <= values.keys()


def test_weights_that_are_not_finite_are_a_divergence(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    with torch.no_grad():
        next(loop.learner.critic.parameters()).fill_(torch.nan)
    with pytest.raises(Divergence, match="epoch 1"):
        loop.run_epoch()


def test_a_network_reads_time_and_start_only_when_told(spec: RunSpec) -> None:
    sizes = {}
    for time in ("true", "false"):
        for start in ("true", "false"):
            made = build_spec("ssail", "yjunction", "smoke", [f"model.time_input={time}", f"model.start_input={start}"])
            sizes[time, start] = TrainingLoop(made, 0).features.size(4)
    assert sizes == {("true", "true"): 9, ("true", "false"): 5, ("false", "true"): 8, ("false", "false"): 4}


def test_the_best_model_uses_every_mode_if_one_does(spec: RunSpec) -> None:
    loop = TrainingLoop(spec, 0)
    kept = []
    for loop.epoch, (error, balance) in enumerate(
        [(0.02, 0.0), (0.03, 0.0), (0.05, 0.4), (0.01, 0.1), (0.04, 0.3), (0.06, 0.5)], 1
    ):
        loop._select(error, balance)
        kept.append((loop.improved, loop.best_epoch))
    assert kept == [(True, 1), (False, 1), (True, 3), (False, 3), (True, 5), (False, 5)]
    loop._select(math.nan, 0.5)
    assert not loop.improved
