"""The benchmark of training steps runs, compares what it says, and notices forms that differ."""

import pytest
import torch

from benchmarks.training_step import (
    check_equal,
    compare_steps,
    first_results,
    largest_difference,
    make_learner,
    one_step,
)


@pytest.mark.parametrize("method", ["nri", "dnri"])
def test_a_training_step_of_both_forms_is_the_same(method: str) -> None:
    """In double precision: losses, outputs, gradients, and the weights after two steps."""
    learners = {form: make_learner(method, "toy", form, torch.float64) for form in ("plain", "fast")}
    plain, fast = (first_results(learner) for learner in learners.values())
    assert any(name.startswith("gradient") for name in plain)
    assert {"encoder 0", "decoder 0", "cloning/loss"} < plain.keys() == fast.keys()
    assert max(largest_difference(plain, fast)) < 1e-7
    for learner in learners.values():
        one_step(learner)
    for mine, other in zip(*(learner.model.parameters() for learner in learners.values()), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-6, atol=1e-8)
    changed = first_results(make_learner(method, "toy", "fast", torch.float64)) | {"decoder 0": fast["decoder 0"] + 1}
    assert max(largest_difference(plain, changed)) > 0.1  # negative control


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    compare_steps("dnri", "toy", rounds=1, steps=1)
    printed = capsys.readouterr().out
    assert "dnri, toy, plain" in printed
    assert "equal in double precision" in printed


def test_forms_that_differ_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even by the last digit, when no digit may differ."""
    monkeypatch.setattr("benchmarks.training_step.TOLERANCE", 1e-18)
    with pytest.raises(SystemExit, match="not the same"):
        check_equal("nri", "toy")
