"""Which runs forecast, on which data, and which of them are drawn."""

import pytest

from ssmail.errors import InputError
from ssmail.plots.data_sets import DataSet, by_data, data_sets, is_own, required
from ssmail.store import RunState, Store

from .conftest import AddRun


def only(store: Store) -> DataSet:
    (found,) = data_sets(store, store.runs())
    return found


def test_runs_on_different_data_are_apart(
    store: Store, add_run: AddRun, add_forecast: AddRun, add_trajectories: AddRun
) -> None:
    add_run()  # on the Y-Junction
    flock = add_trajectories(path="data/flock.npz")
    mocap = add_forecast()
    again = add_trajectories(path="elsewhere/flock.npz", dataset_hash="f" * 64)
    found = {each.name: [run.id for run in each.runs] for each in data_sets(store, store.runs())}
    assert found == {"flock-eeeeeeee": [flock], "mocap": [mocap], "flock-ffffffff": [again]}


def test_runs_in_any_state_are_compared_with_those_on_the_same_data(
    store: Store, add_run: AddRun, add_forecast: AddRun, add_trajectories: AddRun
) -> None:
    """A run that has not read its file yet belongs to that file; generated data has no name."""
    lanes = [add_run(), add_run(1)]
    flock, town = add_trajectories(path="flock.npz"), add_trajectories(path="town.npz", dataset_hash="f" * 64)
    waiting = add_trajectories(1, path="town.npz", dataset_hash=None, state=RunState.INTERRUPTED)
    copied = add_trajectories(1, path="copy-of/flock.npz")
    unread = add_trajectories(path="other/town.npz", dataset_hash=None, state=RunState.FAILED)
    mocap = add_forecast()
    found = [(name, [run.id for run in each]) for name, each in by_data(store.runs())]
    assert found == [
        (None, lanes),
        ("flock", [flock, copied]),
        ("town-ffffffff", [town, waiting]),
        ("town-none", [unread]),
        ("mocap", [mocap]),
    ]


def test_runs_without_errors_make_no_data_set(store: Store, add_trajectories: AddRun) -> None:
    add_trajectories(0, state=RunState.RUNNING)
    add_trajectories(1, state=RunState.DIVERGED)
    assert data_sets(store, store.runs()) == []
    with pytest.raises(InputError, match=r"none of the 2 chosen runs .* run `ssmail train --env traj"):
        required(store, "forecast", store.runs())
    add_trajectories(2)
    assert [run.state.value for run in only(store).runs] == ["diverged", "finished"]


@pytest.mark.parametrize("path", ["..", "../../etc/passwd", "a\n.npz", "x" * 300 + ".npz", "é $x$.npz"])
def test_a_strange_path_gives_a_harmless_name(store: Store, add_trajectories: AddRun, path: str) -> None:
    import json

    add_trajectories(overrides=[f"data.path={json.dumps(path)}"])
    found = only(store)
    assert found.name.isprintable()
    assert len(found.file_name) <= 41
    assert not set(found.file_name) & set("/\\ $\n\x1b")


def test_the_spec_with_the_most_seeds_is_drawn_and_the_others_are_told(store: Store, add_trajectories: AddRun) -> None:
    tuned = [add_trajectories(seed, overrides=["sac.gamma=0.5"]) for seed in (1, 0)]
    add_trajectories(0)
    newer = add_trajectories(0, overrides=["sac.gamma=0.5"])
    dnri = add_trajectories(0, method="dnri")
    add_trajectories(0, method="copy-last")  # a reference of every figure
    chosen = only(store).selection()
    assert [(group.label, [run.id for run in group.runs]) for group in chosen.groups] == [
        ("ssail", [newer, tuned[0]]),
        ("dnri", [dnri]),
    ]
    assert "seeds 0, 1; 1 other stored spec left out (`ssmail plot forecast --runs` chooses)." in chosen.notes[0]


def test_named_runs_are_all_drawn_each_spec_by_itself(store: Store, add_trajectories: AddRun) -> None:
    for overrides in ((), ("sac.gamma=0.5",)):
        add_trajectories(overrides=overrides)
    labels = [group.label for group in only(store).selection(named=True).groups]
    assert labels == [f"ssail {run.spec_hash[:8]}" for run in store.runs()]


def test_a_baseline_alone_is_drawn(store: Store, add_trajectories: AddRun) -> None:
    add_trajectories(method="copy-last")
    assert [group.label for group in only(store).selection().groups] == ["copy-last"]


def test_data_of_the_users_own(store: Store, add_run: AddRun, add_forecast: AddRun, add_trajectories: AddRun) -> None:
    """Recorded motion is the paper's where its file has the name that experiments.yaml gives, wherever it lies."""
    add_run()
    add_forecast()
    add_forecast(overrides=["data.path=/elsewhere/mocap.npz"])
    add_forecast(overrides=["data.path=dancers.npz"])
    add_trajectories()
    assert [is_own(run) for run in store.runs()] == [False, False, False, True, True]
