"""Recorded walking, as recorded motion and as a table of positions: with equal settings, equal numbers.

docs/experiments.md (Own trajectories) lists the settings that differ.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.data import expert_sets
from ssmail.data.importing.dataset import ImportOptions, import_set
from ssmail.data.mocap.dataset import MocapParameters, prepare
from ssmail.data.trajectories import SPLITS, ExpertSet
from ssmail.training.loop import TrainingLoop
from tests.data.mocap.handmade import write_subject

CMU = os.environ.get("SSMAIL_CMU_DIR")
WINDOW, OBSERVED = 50, 25
HERE = ("data", "environment")  # what has to differ
FORECAST = ("evaluation", "forecast")
# The same forecast, without noise, and as little as shows the numbers.
BOTH = (
    *(f"forecast.observed={OBSERVED}", f"forecast.predicted={WINDOW - OBSERVED}", "forecast.noise=0"),
    *("training.epochs=1", "evaluation.train_rollouts=1", "evaluation.samples=1", "evaluation.validation_samples=1"),
)
DIFFER = {
    "dnri": {
        f"variational.{key}"
        for key in ("root_relative", "centre_relative", "agent_input", "standardize", "first_type_is_none", "variance")
    },
    "ssail": {
        *(f"model.{k}" for k in ("root_relative", "centre_relative", "agent_input", "standardize")),
        *(f"model.{k}" for k in ("action_step", "action_bound")),
        *(f"adversarial.{k}" for k in ("learning_rate", "learning_rate_final", "updates", "time_steps")),
        *(f"adversarial.{k}" for k in ("input_noise", "reward_limit")),
        *(f"sac.{k}" for k in ("gamma", "actor_learning_rate", "actor_start", "critic_learning_rate_final")),
        *(f"sac.{k}" for k in ("temperature_learning_rate", "target_entropy", "encoder_steps")),
        *(f"sac.{k}" for k in ("expansion_steps", "graph_entropy", "average")),
        "curriculum.name",
    },
}


@pytest.fixture(
    scope="module",
    params=["handmade", pytest.param("CMU", marks=pytest.mark.skipif(not CMU, reason="SSMAIL_CMU_DIR is not set"))],
)
def roads(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A trial to train on, one to validate and one to test, in the expert sets of both environments."""
    folder = tmp_path_factory.mktemp("walking")
    source = Path(str(CMU)) if request.param == "CMU" else write_subject(folder / "35", {1: 201, 2: 101, 3: 151})
    wanted = MocapParameters(subject=35, train=(1,), validation=(2,), test=(3,), test_window=WINDOW)
    mocap = prepare(source, wanted)
    table(mocap).to_csv(folder / "walking.csv", index=False)
    options = ImportOptions(window=WINDOW, stride=WINDOW, validation=("walk2",), test=("walk3",))
    imported, _ = import_set([folder / "walking.csv"], options)
    paths = {name: folder / f"{name}.npz" for name in ("mocap", "trajectories")}
    expert_sets.save(mocap, paths["mocap"])
    expert_sets.save(imported, paths["trajectories"])
    return paths


def table(mocap: ExpertSet) -> pd.DataFrame:
    """One row per joint and frame. The windows of a trial follow one another, after the frame before the first one."""
    parts = []
    for number, split in enumerate(SPLITS, start=1):
        windows = getattr(mocap, split)
        before = windows.positions[0, :1] - windows.velocities[0, :1]
        frames = np.concatenate([before, windows.positions.reshape(-1, *before.shape[1:])])
        frame, joint = (index.ravel() for index in np.indices(frames.shape[:2]))
        row = {"scene": f"walk{number}", "frame": frame, "agent": joint}
        parts.append(pd.DataFrame(row | dict(zip("xyz", frames.reshape(-1, 3).T, strict=True))))
    return pd.concat(parts)


def flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{section}.{key}": value
        for section, values in settings.items()
        if isinstance(values, Mapping) and section not in HERE
        for key, value in values.items()
    }


def specs(method: str, roads: Mapping[str, Path], *equal: str) -> dict[str, RunSpec]:
    return {
        environment: build_spec(method, environment, "smoke", [f"data.path={path}", *equal])
        for environment, path in roads.items()
    }


def differing(method: str, roads: Mapping[str, Path]) -> dict[str, Any]:
    """The settings that differ between the environments, with their values on recorded motion."""
    mocap, own = (flat(spec.model_dump(mode="json")) for spec in specs(method, roads).values())
    return {key: value for key, value in mocap.items() if own[key] != value and key.split(".")[0] not in FORECAST}


def test_the_positions_are_the_same(roads: dict[str, Path]) -> None:
    mocap, own = (expert_sets.load(path) for path in roads.values())
    for split in SPLITS:
        for name in ("positions", "velocities"):
            one, other = (getattr(getattr(experts, split), name) for experts in (mocap, own))
            np.testing.assert_allclose(other, one, rtol=0, atol=1e-12)
    assert own.parameters["identity"] is True


@pytest.mark.parametrize("method", ["dnri", "ssail"])
def test_with_equal_settings_both_roads_lead_to_the_same_numbers(method: str, roads: dict[str, Path]) -> None:
    wanted = differing(method, roads)
    assert wanted.keys() == DIFFER[method]
    equal = [f"{key}={'null' if value is None else value}".replace("True", "true") for key, value in wanted.items()]
    equal = [setting.replace("False", "false") for setting in equal]
    trained, losses = {}, {}
    for environment, spec in specs(method, roads, *BOTH, *equal).items():
        loop = trained[environment] = TrainingLoop(spec, 0)
        epochs = [loop.run_epoch() for _ in range(spec.epochs)]
        losses[environment] = [[v for k, v in sorted(e.items()) if is_of_training(k)] for e in epochs]
    np.testing.assert_allclose(losses["trajectories"], losses["mocap"], rtol=1e-4, atol=1e-6)
    mocap, own = (loop.learner.predictor.model.state_dict() for loop in trained.values())
    for name, weights in mocap.items():
        np.testing.assert_allclose(own[name], weights, rtol=1e-3, atol=1e-5, err_msg=name)
    one, other = (loop.evaluator.final(*[loop.learner.predictor] * 3)[0] for loop in trained.values())
    sampled = [] if method == "ssail" else ["test_mean"]  # a policy draws its graph, each evaluation in its own order
    for name in (f"{of}/mse_{h}" for of in (*sampled, "test_constant_velocity", "test_copy_last") for h in (1, 10, 20)):
        assert other[name] == pytest.approx(one[name], rel=1e-3), name


@pytest.mark.parametrize("method", ["dnri"])
def test_with_the_settings_of_own_trajectories_they_do_not(method: str, roads: dict[str, Path]) -> None:
    """The negative control."""
    first = [TrainingLoop(spec, 0).run_epoch() for spec in specs(method, roads, *BOTH).values()]
    assert first[0]["cloning/loss"] != pytest.approx(first[1]["cloning/loss"], rel=1e-2)


def is_of_training(name: str) -> bool:
    return name.split("/")[0] not in ("validation", "train", "time") and "seconds" not in name
