"""Merging: every cell once, both directions of every rivalry, and nothing half done."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.errors import InputError
from ssmail.store import RunState, Store
from ssmail.store.checkpoint_files import CheckpointCopies
from ssmail.store.maintenance import merge as module
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.merge import Fate, merge
from tests.store.databases import SPEC, add, change, contents, files

NewStore = Callable[[str], Store]
FINISHED, DIVERGED, INTERRUPTED = RunState.FINISHED, RunState.DIVERGED, RunState.INTERRUPTED


@pytest.fixture
def here(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "here" / "ssmail.db")


@pytest.fixture
def there(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "there" / "ssmail.db")


def fates(here: Store, there: Store) -> list[Fate]:
    """Of a merge of `there` into `here`, by seed."""
    done = merge(here.where, there.where)
    assert done.without_checkpoints == ()
    return [item.fate for item in sorted(done.runs, key=lambda item: item.run.seed)]


def test_new_cells_are_added_with_all_they_recorded(here: Store, there: Store) -> None:
    ours = add(here, 0)
    theirs = [add(there, 1), add(there, 0, overrides=["sac.gamma=0.5"]), add(there, 0, dataset_hash="e" * 64)]
    before = contents(here.where)
    assert merge(here.where, there.where).count(Fate.ADDED) == 3
    assert {run.id for run in here.runs()} == {ours, *theirs}
    assert {table: len(rows) for table, rows in contents(here.where).items()} == {
        table: 4 * len(rows) for table, rows in before.items()
    }
    np.testing.assert_array_equal(here.array(theirs[0], "test/rollouts"), np.arange(4.0) + 1)
    assert files(here.checkpoint_root).keys() == {f"{name}/last.pt" for name in (ours, *theirs)}
    assert check(here.where) == []


def test_equal_runs_of_a_cell_are_kept_once_however_long_they_took(here: Store, there: Store) -> None:
    ours = add(here, 0, seconds=1.0)
    add(there, 0, seconds=2.0)
    before = contents(here.where)
    assert fates(here, there) == [Fate.ALREADY_THERE]
    assert contents(here.where) == before
    assert [run.id for run in here.runs()] == [ours]


@pytest.mark.parametrize(
    ("theirs", "final", "metric", "step", "values"),
    [
        ([0.3, 0.25, 0.1], {"test/mode_mse": 9.0}, "validation/mode_mse", 2, (0.2, 0.25)),
        ([0.3, 0.2, 0.1], {"test/mode_mse": 0.06, "test/lag": np.nan}, "test/mode_mse", 3, (0.05, 0.06)),
        ([0.3, 0.2, 0.1], {"test/mode_mse": 0.05, "test/lag": 0.0}, "test/lag", 3, ("nan", 0.0)),
        ([0.3, 0.2, 0.1], {"test/mode_mse": 0.05}, "test/lag", 3, ("nan", None)),
        ([0.3, 0.2], {"test/mode_mse": 0.05, "test/lag": np.nan}, "test/lag", 2, (None, "nan")),
    ],
)
def test_unequal_runs_of_a_cell_are_nondeterminism(
    theirs: list[float], final: dict[str, float], metric: str, step: int, values: object, here: Store, there: Store
) -> None:
    ours = add(here, 0, [0.3, 0.2, 0.1])
    other = add(there, 0, theirs, final=final)
    before = contents(here.where), files(here.checkpoint_root)
    done = merge(here.where, there.where)
    (found,) = done.differences
    assert (found.kept, found.left_out, found.method, found.seed) == (ours, other, "ssail", 0)
    assert (found.metric, found.step) == (metric, step)
    assert (found.kept_value, found.left_out_value) == values
    assert (contents(here.where), files(here.checkpoint_root)) == before


def test_two_ways_to_end_are_nondeterminism_too(here: Store, there: Store) -> None:
    add(here, 0, [0.3, 0.2], DIVERGED)
    add(there, 0, [0.3, 0.2], FINISHED, final={})
    (found,) = merge(here.where, there.where).differences
    assert (found.metric, found.step, found.kept_value, found.left_out_value) == ("state", None, "diverged", "finished")


@pytest.mark.parametrize(
    ("ours", "theirs", "fate"),
    [
        (([0.3], INTERRUPTED), ([0.3, 0.2], FINISHED), Fate.REPLACED),
        (([0.3], INTERRUPTED), ([0.3], DIVERGED), Fate.REPLACED),
        (([0.3, 0.2], FINISHED), ([0.3], INTERRUPTED), Fate.BEHIND),
        (([0.3], INTERRUPTED), ([0.3, 0.2], RunState.FAILED), Fate.REPLACED),
        (([0.3, 0.2], INTERRUPTED), ([0.3], INTERRUPTED), Fate.BEHIND),
        (([0.3], INTERRUPTED), ([0.3], INTERRUPTED), Fate.ALREADY_THERE),
        (([0.3], RunState.RUNNING), ([0.3, 0.2], FINISHED), Fate.BUSY),
        (([0.3, 0.2], FINISHED), ([0.3], RunState.RUNNING), Fate.BUSY),
    ],
)
def test_the_run_that_got_further_is_kept(
    ours: tuple[list[float], RunState], theirs: tuple[list[float], RunState], fate: Fate, here: Store, there: Store
) -> None:
    old, new = add(here, 0, *ours), add(there, 0, *theirs)
    assert fates(here, there) == [fate]
    kept = new if fate is Fate.REPLACED else old
    assert [run.id for run in here.runs()] == [kept]
    assert {path.name for path in here.checkpoint_root.iterdir()} == {kept}
    assert check(here.where) == []


def test_a_run_that_was_continued_elsewhere_comes_back_with_its_checkpoint(here: Store, there: Store) -> None:
    run_id = add(here, 0, [0.3], INTERRUPTED)
    merge(there.where, here.where)
    writer = there.resume_run(run_id, 1)
    writer.epoch(2, {"validation/mode_mse": 0.2, "actor/loss": 0.0})
    (there.checkpoint_root / run_id / "last.pt").write_bytes(b"further")
    writer.final(2, {"test/mode_mse": 0.1})
    writer.artifact("last.pt")
    writer.finish(FINISHED)
    assert fates(here, there) == [Fate.REPLACED]
    assert contents(here.where) == contents(there.where)
    assert files(here.checkpoint_root) == files(there.checkpoint_root) == {f"{run_id}/last.pt": b"further"}


def test_missing_checkpoints_are_mended_by_a_sound_copy(here: Store, there: Store) -> None:
    run_id = add(there, 0)
    merge(here.where, there.where)
    (here.checkpoint_root / run_id / "last.pt").unlink()
    assert [problem.check for problem in check(here.where)] == ["checkpoints"]
    assert fates(here, there) == [Fate.ALREADY_THERE]
    assert check(here.where) == []


def test_runs_that_come_without_their_checkpoints_are_told(here: Store, there: Store) -> None:
    run_id = add(there, 0)
    shutil.rmtree(there.checkpoint_root)
    assert merge(here.where, there.where).without_checkpoints == (run_id,)
    assert not here.checkpoint_root.exists()


def test_two_databases_in_one_folder_share_their_checkpoints(tmp_path: Path) -> None:
    one, two = Store.open(tmp_path / "one.db"), Store.open(tmp_path / "two.db")
    add(one, 0)
    add(two, 1)
    before = files(one.checkpoint_root)
    assert fates(one, two) == [Fate.ADDED]
    assert files(one.checkpoint_root) == before
    assert check(one.where) == check(two.where) == []


RUNS = st.lists(
    st.tuples(
        st.integers(0, 1),
        st.lists(st.sampled_from([0.3, 0.2, np.nan, -np.inf]), max_size=2),
        st.sampled_from([FINISHED, DIVERGED, INTERRUPTED, RunState.FAILED]),
        st.sampled_from(["d" * 64, "e" * 64, None]),
    ),
    max_size=4,
)


def filled(path: Path, runs: list[tuple[int, list[float], RunState, str | None]]) -> Store:
    store = Store.open(path)
    for seed, errors, state, dataset_hash in runs:
        add(store, seed, errors or ([0.1] if state is FINISHED else []), state, dataset_hash=dataset_hash)
    return store


@settings(max_examples=8)
@given(runs=RUNS, others=RUNS)
def test_merging_into_nothing_copies_and_merging_twice_is_merging_once(runs: list, others: list) -> None:  # type: ignore[type-arg]
    with tempfile.TemporaryDirectory() as folder:
        one, two = filled(Path(folder, "1", "a.db"), runs), filled(Path(folder, "2", "b.db"), others)
        copy = Path(folder, "3", "new.db")
        merge(copy, one.where)
        assert contents(copy) == contents(one.where)
        assert files(copy.parent / "checkpoints") == files(one.checkpoint_root)
        merge(copy, two.where)
        once = contents(copy), files(copy.parent / "checkpoints")
        again = merge(copy, two.where)
        assert (contents(copy), files(copy.parent / "checkpoints")) == once
        assert not any(item.enters for item in again.runs)
        assert check(copy) == []
        one.close()
        two.close()


@pytest.fixture
def rivals(here: Store, there: Store) -> list[str]:
    """Runs to be added, replaced, continued and kept."""
    shared = add(here, 5, [0.3], INTERRUPTED)
    merge(there.where, here.where)
    writer = there.resume_run(shared, 1)
    writer.epoch(2, {"validation/mode_mse": 0.2})
    (there.checkpoint_root / shared / "last.pt").write_bytes(b"further")
    writer.finish(INTERRUPTED, "stopped")
    add(here, 0)
    add(here, 1, [0.3], INTERRUPTED)
    for seed in (1, 2, 3):
        add(there, seed)
    here.close()
    there.close()
    return [here.where, there.where]


def clear_folders(store: Store) -> None:
    """Do what `check` says of folders that belong to no run."""
    for problem in check(store.where):
        if problem.check == "folders":
            shutil.rmtree(store.checkpoint_root / problem.subject)


@pytest.mark.parametrize("place", ["copy_run", "stage", "place"])
def test_a_failure_leaves_everything_as_it_was(
    place: str, rivals: list[str], here: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(here.where), files(here.checkpoint_root)
    owner = module if place == "copy_run" else CheckpointCopies
    real, calls = getattr(owner, place), []

    def fails(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) == 2:
            raise OSError("no space left on device")
        return real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, place, fails)
        with pytest.raises(OSError, match="no space left"):
            merge(*rivals)
    after = contents(here.where), files(here.checkpoint_root)
    if place == "place":  # the second one comes after the commit, and only exchanges files of a run that was there
        assert {problem.check for problem in check(here.where)} == {"folders"}
    else:
        assert after == before
    merge(*rivals)
    clear_folders(here)
    assert check(here.where) == []
    assert len(here.runs()) == 5


KILLED = """
import os, signal, sys
from ssmail.store.maintenance import merge as merging
from ssmail.store.checkpoint_files import CheckpointCopies
owner = {"merging": merging, "files": CheckpointCopies}[sys.argv[3]]
real, calls = getattr(owner, sys.argv[4]), []
def dies(*arguments):
    calls.append(arguments)
    if len(calls) == int(sys.argv[5]):
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments)
setattr(owner, sys.argv[4], dies)
merging.merge(sys.argv[1], sys.argv[2])
"""


@pytest.mark.parametrize("moment", [("files", "stage", "2"), ("merging", "copy_run", "3"), ("files", "commit", "1")])
def test_a_merge_that_is_killed_leaves_the_target_as_it_was(
    moment: tuple[str, str, str], rivals: list[str], here: Store
) -> None:
    """The last moment is after the commit, before the checkpoint of a run that was there is exchanged."""
    before = contents(here.where)
    killed = subprocess.run([sys.executable, "-c", KILLED, *rivals, *moment], check=False, env=dict(os.environ))
    assert killed.returncode == -signal.SIGKILL
    problems = {problem.check for problem in check(here.where)}
    assert problems <= {"folders"}
    if moment[1] != "commit":
        assert contents(here.where) == before
    merge(*rivals)
    clear_folders(here)
    assert check(here.where) == []
    assert len(here.runs()) == 5


def test_what_cannot_be_merged_is_refused_and_changes_nothing(here: Store, there: Store, tmp_path: Path) -> None:
    add(here, 0)
    before = contents(here.where)
    refused = {
        here.where: "is the database itself",
        str(tmp_path / "missing.db"): "there is no database",
    }
    (tmp_path / "garbage.db").write_bytes(b"no database at all " * 300)
    refused[str(tmp_path / "garbage.db")] = r"garbage\.db is not an SQLite database"
    change(there.where, "UPDATE alembic_version SET version_num = '0999'")
    refused[there.where] = "written by a newer ssmail"
    for other, sentence in refused.items():
        with pytest.raises(InputError, match=sentence) as caught:
            merge(here.where, other)
        assert "\n" not in str(caught.value)
    assert contents(here.where) == before


def test_an_older_schema_is_one_sentence_with_the_remedy(
    here: Store, there: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ssmail.store import connection
    from ssmail.store.maintenance import whole_databases

    for owner in (connection, whole_databases):
        monkeypatch.setattr(owner, "REVISIONS", ("0001", "0002"))
    sentence = (
        rf"has schema 0001, but this ssmail reads 0002; upgrade it first with `ssmail db upgrade --db {there.where}`"
    )
    with pytest.raises(InputError, match=sentence):
        merge(here.where, there.where)


def test_a_run_that_is_being_computed_goes_on_meanwhile(here: Store, there: Store) -> None:
    """Its process waits for the one transaction of the merge, and loses nothing."""
    for seed in (1, 2):
        add(there, seed)
    writer = here.start_run(SPEC, 0, dataset_hash="d" * 64, device="cpu")
    done, epochs = threading.Event(), []

    def write() -> None:
        while not done.is_set():
            epochs.append(len(epochs) + 1)
            writer.epoch(epochs[-1], {"validation/mode_mse": 1.0 / epochs[-1]})

    thread = threading.Thread(target=write)
    thread.start()
    try:
        assert fates(here, there) == [Fate.ADDED, Fate.ADDED]
    finally:
        done.set()
        thread.join()
    writer.finish(INTERRUPTED)
    assert here.metrics([writer.run_id])["step"].tolist() == epochs
    assert len(here.runs()) == 3
