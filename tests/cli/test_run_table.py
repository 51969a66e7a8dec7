"""The metrics that are shown of each environment are those that its runs record."""

from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.names import ENVIRONMENTS
from ssmail.data import expert_sets
from ssmail.training.loop import TrainingLoop
from ssmail_cli.progress import LABELS
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics, key_metrics
from tests.data import flocks
from tests.data.mocap.handmade import write_set


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_what_is_shown_is_recorded(environment: str, tmp_path: Path) -> None:
    overrides = []
    if environment == "mocap":
        windows = write_set(tmp_path / "mocap.npz", frames=(101, 51, 101), window=50, test_window=100)
        overrides = [f"data.path={windows}", "forecast.predicted=40"]
    if environment == "trajectories":
        expert_sets.save(flocks.generate([2, 3], scenes=8), tmp_path / "flock.npz")
        measured = ["evaluation.samples=20", "forecast.collision_distance=1"]
        overrides = [f"data.path={tmp_path / 'flock.npz'}", *measured]
    loop = TrainingLoop(build_spec("constant-velocity", environment, "smoke", overrides), 0)
    shown = ENVIRONMENT_METRICS[environment]
    assert {shown.validation, shown.curve} <= loop.evaluator.epoch(loop.learner.predictor).keys()
    assert shown.validation in LABELS
    final, _ = loop.final_evaluation()
    assert shown.error in shown.compared
    assert shown.compared.keys() <= final.keys()
    assert set(shown.spare) <= shown.compared.keys()
    for prefix in shown.beside.values():
        assert any(name.startswith(f"{prefix}/") for name in final)


def test_metrics_that_environments_share_come_once() -> None:
    assert list(ENVIRONMENT_METRICS) == list(ENVIRONMENTS)
    both = key_metrics(ENVIRONMENTS)
    assert set(both) == {name for shown in ENVIRONMENT_METRICS.values() for name in shown.compared}
    assert list(key_metrics(["mocap"])) == list(ENVIRONMENT_METRICS["mocap"].compared)
    assert key_metrics([]) == {}
    assert environment_metrics("football") is ENVIRONMENT_METRICS["yjunction"]
