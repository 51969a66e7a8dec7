"""What is measured on the Y-Junction at every epoch: the turning of the validation rollouts."""

import pytest
import torch
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.evaluation.metrics import TURNING, turning
from ssmail.training.baselines import Baseline
from ssmail.training.loop import TrainingLoop


class Expert(Baseline):
    """Goes on as the expert trajectory (T, N, D) with the start nearest to the given one."""

    def __init__(self, known: Tensor) -> None:
        super().__init__()
        self.known = known  # (B, T, N, D)

    def free_run(self, observed: Tensor, steps: int, generator: torch.Generator, **reading: object) -> Tensor:
        apart = (observed[:, None, -1] - self.known[None, :, 0]).square().sum(dim=(-2, -1))
        return self.known[apart.argmin(dim=1), : steps + 1]


@pytest.fixture(scope="module")
def loop() -> TrainingLoop:
    return TrainingLoop(build_spec("constant-velocity", "yjunction", "quick"), 0)


def test_an_epoch_tells_whether_agents_turn_where_the_road_does(loop: TrainingLoop) -> None:
    states = [loop.evaluator.states(split) for split in (loop.data.validation, loop.data.train)]
    values = loop.evaluator.epoch(Expert(torch.cat(states)))
    found = {name: values[f"validation/{name}"] for name in TURNING}
    truth = loop.data.validation
    assert found == pytest.approx(turning(truth.positions, truth.continuations), abs=1e-4)
    assert found == pytest.approx({"turn_own": -1, "turn_others": 0, "turn_group": -1, "turn_lead": 0}, abs=0.15)
    assert not any(name.startswith("train/turn") for name in values)


def test_who_goes_straight_has_no_turn_in_any_epoch(loop: TrainingLoop) -> None:
    """The control: the numbers are those of the rollouts, not of the expert."""
    values = loop.evaluator.epoch(loop.evaluator.constant_velocity)
    assert not any("turn" in name for name in values)
    assert values["validation/path_rms"] > 3
