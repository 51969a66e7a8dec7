"""The model of a stored run predicts as the loop that trained it, in raw units, with or without its expert set."""

import hashlib
import json
import shutil
import sqlite3
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import ssmail
from ssmail.errors import InputError
from ssmail.inference.trained_run import TrainedRun, load_run
from ssmail.store.artifact_storage import ArtifactStorage
from ssmail.training.batches import to_numpy
from ssmail.training.checkpoint import UnfitState, load_checkpoint, save_checkpoint
from ssmail.training.learner import Predictor
from ssmail.training.predictor_spec import PredictorSpec
from tests.inference.conftest import Train, Trained

WALK = np.cumsum(np.full((2, 4, 3, 2), 0.7), axis=1) + np.arange(3)[:, None] * 4  # two groups of three that walk on


def observed_of(run: Trained, states: int) -> np.ndarray:
    """The first frames of the test split, and the one before them."""
    test = run.loop.data.test
    return np.concatenate([test.positions[:, :1] - test.velocities[:, :1], test.positions[:, :states]], axis=1)


def best_of(run: Trained) -> Predictor:
    best = deepcopy(run.loop.learner.predictor)
    best.model.load_state_dict(run.loop.best["weights"])
    return best


@pytest.mark.parametrize(
    ("method", "environment"),
    [("ssail", "yjunction"), ("dnri", "yjunction"), ("nri", "letters"), ("ssail", "mocap"), ("dnri", "mocap")],
)
def test_it_predicts_as_the_loop_that_trained_it(train: Train, method: str, environment: str) -> None:
    trained = train(method, environment)
    run = load_run(trained.id[:10], trained.db)
    states = run.observed or 0
    steps = run.predicted or 0
    made = run.rollout(observed_of(trained, states), steps, samples=2, seed=5)
    truth = trained.loop.evaluator.states(trained.loop.data.test)[:, :states]  # type: ignore[attr-defined]
    generator = torch.Generator().manual_seed(5)
    expected = best_of(trained).free_run(truth.repeat(2, 1, 1, 1), steps, generator)[:, 1:]
    scaled = to_numpy(expected[..., : expected.shape[-1] // 2]).reshape(made.shape)
    scaling = trained.loop.scaling
    np.testing.assert_allclose(made, scaling.unscale_positions(scaled), atol=1e-4 * scaling.position_span)
    assert np.abs(made - run.rollout(observed_of(trained, states), steps, samples=2, seed=6)).max() > 1e-3


def test_the_same_seed_yields_the_same_numbers_for_one_group_and_many(train: Train) -> None:
    run = load_run(train("ssail").id, train("ssail").db)
    both, one = run.rollout(WALK, 5, samples=3, seed=1), run.rollout(WALK[0], 5, samples=3, seed=1)
    assert both.shape == (3, 2, 5, 3, 2)
    assert one.shape == (3, 5, 3, 2)
    np.testing.assert_array_equal(one, run.rollout(WALK[:1], 5, samples=3, seed=1)[:, 0])
    np.testing.assert_array_equal(both, run.rollout(WALK, 5, samples=3, seed=1))
    assert not np.array_equal(both, run.rollout(WALK, 5, samples=3, seed=2))
    assert len(np.unique(both[:, 0, -1, 0, 0])) == 3


def test_another_number_of_agents_is_predicted_unless_the_model_tells_them_apart(train: Train) -> None:
    plain, joints = (load_run(train(*name).id, train(*name).db) for name in (("ssail",), ("ssail", "mocap")))
    crowd = np.cumsum(np.full((4, 7, 2), 0.7), axis=0)
    assert plain.agents is None
    assert plain.rollout(crowd, 3).shape == (1, 3, 7, 2)
    assert joints.agents == 5
    with pytest.raises(InputError, match="tells its 5 agents apart, so it cannot predict 4"):
        joints.rollout(np.cumsum(np.ones((3, 4, 3)), axis=0), 3)


def test_baselines_are_closed_forms_in_any_units(train: Train) -> None:
    far = 5e5 + WALK[..., :1]  # one axis
    steps = np.arange(1, 6)[:, None, None]
    keep, stay = (load_run(train(name).id, train(name).db) for name in ("constant-velocity", "copy-last"))
    expected = far[0, -1] + steps * (far[0, -1] - far[0, -2])
    np.testing.assert_allclose(keep.rollout(far[0], 5, samples=2), [expected] * 2, atol=1e-6)
    np.testing.assert_allclose(stay.rollout(far[0], 5), [[far[0, -1]] * 5], atol=1e-6)
    assert (keep.axes, keep.agents, keep.predicted) == (None, None, 49)


def test_what_cannot_be_predicted_is_one_sentence(train: Train) -> None:
    run = load_run(train("ssail").id, train("ssail").db)
    broken = WALK.copy()
    broken[0, 1, 2, 0] = np.nan
    for observed, steps, said in (
        (WALK[..., :1], 3, "have 1 axes P, and the model has 2"),
        (WALK[:, :1], 3, "two observed frames"),
        (WALK[0, 0], 3, "not 2 axes"),
        (WALK[:, :, :0], 3, "no agent"),
        (broken, 3, "NaN"),
        ([["a"]], 3, "not an array of numbers"),
        ([[1.0], [1.0, 2.0]], 3, "not an array of numbers"),
        (WALK, 0, "at least 1"),
        (WALK * 1e12, 3, "check the units"),
        (WALK, 48, "ask for at most 47 steps"),
        (np.repeat(WALK, 20, axis=1), 1, "observe at most 50 frames"),
    ):
        with pytest.raises(InputError, match=said):
            run.rollout(observed, steps)
    assert run.rollout(WALK, 47).shape[2] == 47


@pytest.mark.parametrize("value", [2.5, 2.0, "2", None, np.ones(2), 2**70])
@pytest.mark.parametrize("name", ["steps", "samples", "seed"])
def test_counts_that_are_no_whole_numbers_are_one_sentence(train: Train, name: str, value: Any) -> None:
    run = load_run(train("ssail").id, train("ssail").db)
    with pytest.raises(InputError, match=f"^{name} is a whole number"):
        run.rollout(WALK, **{"steps": 3, name: value})
    assert run.rollout(WALK, **{"steps": 3, name: np.int64(2)}).ndim == 5


def test_the_last_model_is_another_one(train: Train) -> None:
    trained = train("ssail")
    last = load_run(trained.id, trained.db, model="last")
    own = trained.loop.learner.predictor.model.state_dict()
    assert last.epoch == 2
    assert all(torch.equal(value, own[name]) for name, value in last.predictor.model.state_dict().items())
    assert last.metrics["test_last/mode_mse"] == load_run(trained.id, trained.db).metrics["test_last/mode_mse"]
    with pytest.raises(InputError, match="choose one of the two"):
        load_run(trained.id, trained.db, model="worst")  # type: ignore[arg-type]


def test_an_averaged_policy_is_the_one_that_was_evaluated(train: Train) -> None:
    trained = train("ssail", "yjunction", "sac.average=0.1")
    last = load_run(trained.id, trained.db, model="last").predictor.model.state_dict()
    learner: Any = trained.loop.learner
    averaged, current = learner.actor_critic.averaged.state_dict(), learner.actor_critic.policy.state_dict()
    assert all(torch.equal(value, averaged[name]) for name, value in last.items())
    assert not all(torch.equal(value, current[name]) for name, value in last.items())


# -- checkpoints of earlier versions, and of others --------------------------------------------------------------------


def copied(trained: Trained, folder: Path, change: Any) -> Path:
    """A copy of the database whose best checkpoint has been changed and recorded anew."""
    shutil.copytree(trained.db.parent, folder)
    (folder / "mocap.npz").unlink(missing_ok=True)
    best = folder / "checkpoints" / trained.id / "best.pt"
    state = load_checkpoint(best)
    change(state)
    save_checkpoint(best, state)
    with sqlite3.connect(folder / "ssmail.db") as connection:
        recorded = hashlib.sha256(best.read_bytes()).hexdigest(), best.stat().st_size, trained.id
        connection.execute(
            "UPDATE artifact SET sha256 = ?, size_bytes = ? WHERE run_id = ? AND name = 'best.pt'", recorded
        )
    connection.close()
    return folder / "ssmail.db"


def test_an_earlier_checkpoint_is_read_with_the_set_that_its_spec_generates(train: Train, tmp_path: Path) -> None:
    trained = train("ssail")
    db = copied(trained, tmp_path / "old", lambda state: state.pop("predictor"))
    expected = load_run(trained.id, trained.db).rollout(WALK, 5)
    np.testing.assert_array_equal(load_run(trained.id, db).rollout(WALK, 5), expected)


def test_an_earlier_checkpoint_on_a_file_needs_that_file_and_no_other(train: Train, tmp_path: Path) -> None:
    trained = train("ssail", "mocap")
    db = copied(trained, tmp_path / "old", lambda state: state.pop("predictor"))
    observed = observed_of(trained, 6)
    expected = load_run(trained.id, trained.db).rollout(observed, 4)
    with pytest.raises(InputError, match=r"before ssmail stored the scaling in it; give the expert set .* data=FILE"):
        load_run(trained.id, db)
    np.testing.assert_array_equal(load_run(trained.id, db, data=trained.set).rollout(observed, 4), expected)
    with sqlite3.connect(db) as connection:
        connection.execute("UPDATE run SET dataset_hash = ?", ["0" * 64])
    connection.close()
    with pytest.raises(InputError, match=r"is not what run .* was trained on"):
        load_run(trained.id, db, data=trained.set)


def test_a_new_checkpoint_needs_no_file(train: Train, tmp_path: Path) -> None:
    trained = train("ssail", "mocap")
    db = copied(trained, tmp_path / "moved", lambda state: None)
    np.testing.assert_array_equal(
        load_run(trained.id, db).rollout(observed_of(trained, 6), 4),
        load_run(trained.id, trained.db).rollout(observed_of(trained, 6), 4),
    )


def test_a_checkpoint_in_a_shared_place_is_found_where_the_user_says(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained, place = train("ssail"), f"memory://{tmp_path.name}"
    shutil.copy(trained.db, tmp_path / "alone.db")
    for file in (trained.db.parent / "checkpoints" / trained.id).iterdir():
        ArtifactStorage(place).put(trained.id, file.read_bytes())
    expected = load_run(trained.id, trained.db).rollout(WALK, 5)
    np.testing.assert_array_equal(
        load_run(trained.id, tmp_path / "alone.db", artifacts=place).rollout(WALK, 5), expected
    )
    with pytest.raises(InputError, match="give the place that it was trained with as --artifacts"):
        load_run(trained.id, tmp_path / "alone.db")
    monkeypatch.setenv("SSMAIL_ARTIFACTS", place)
    np.testing.assert_array_equal(load_run(trained.id, tmp_path / "alone.db").rollout(WALK, 5), expected)


def larger(state: dict[str, Any], section: str, key: str, value: object) -> None:
    spec = json.loads(state["predictor"]["spec"])
    spec[section][key] = value
    state["predictor"]["spec"] = json.dumps(spec)


CHANGES = {
    "networks of another size": lambda state: larger(state, "model", "hidden", 10**9),
    "countless edge types": lambda state: larger(state, "model", "edge_types", 10**9),
    "an unknown method": lambda state: state["predictor"].update(spec='{"method": "magic"}'),
    "a weight that is NaN": lambda state: next(iter(state["policy"].values())).fill_(float("nan")),
    "no weights": lambda state: state.pop("policy"),
    "a scaling of nothing": lambda state: state["predictor"].update(scaling=[0.0, 0.0, 0.0, 1.0]),
    "many axes": lambda state: state["predictor"].update(state_size=10**6),
    "other features": lambda state: state["predictor"].update(features={"time": "yes"}),
}


@pytest.mark.parametrize("name", list(CHANGES))
def test_a_checkpoint_of_someone_else_is_refused_in_one_sentence(train: Train, tmp_path: Path, name: str) -> None:
    trained = train("ssail")
    db = copied(trained, tmp_path / "theirs", CHANGES[name])
    with pytest.raises(InputError, match=r"does not fit its run .*; train it again"):
        load_run(trained.id, db)


@given(data=st.data())
def test_any_description_is_read_or_unfit(train: Train, data: st.DataObject) -> None:
    """Values of all kinds in the places of a description: it is refused as UnfitState, or makes a predictor."""
    trained = train("ssail", "mocap")
    state = deepcopy(trained.loop.predictor_spec.state_dict())
    odd = st.one_of(st.none(), st.integers(), st.floats(), st.text(max_size=5), st.just(torch.zeros(2, 3)), st.just([]))
    place = data.draw(
        st.sampled_from(
            ["state_size", "scaling", "features", "bounds", "steps", "agents", "mean", "std", "step", "low"]
        )
    )
    inner = {"steps": state["features"], "agents": state["features"], "mean": state["features"]["normalization"]}
    inner |= {"std": inner["mean"], "step": state["bounds"], "low": state["bounds"]}
    inner.get(place, state)[place] = data.draw(odd)
    try:
        PredictorSpec.from_state(state).make(trained.loop.best["weights"])
    except UnfitState:
        return
    assert place in ("steps", "scaling", "step") or state == trained.loop.predictor_spec.state_dict()


def test_a_run_without_its_checkpoints_and_a_database_that_is_not_there(train: Train, tmp_path: Path) -> None:
    trained = train("ssail")
    shutil.copy(trained.db, tmp_path / "alone.db")
    with pytest.raises(InputError, match="has no model: there is no"):
        load_run(trained.id, tmp_path / "alone.db")
    with pytest.raises(InputError, match="there is no database"):
        load_run(trained.id, tmp_path / "none.db")
    assert not (tmp_path / "none.db").exists()
    with pytest.raises(InputError, match="no run id starts with"):
        load_run("ffffffffffff", trained.db)


def test_the_package_names_it(train: Train) -> None:
    assert ssmail.load_run is load_run
    assert ssmail.TrainedRun is TrainedRun
    assert {"load_run", "TrainedRun", "InputError"} <= set(dir(ssmail))
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = ssmail.magic
