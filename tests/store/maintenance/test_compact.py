"""Compact exports: which runs, which rows, parts of arrays, and no half files."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ssmail.errors import InputError
from ssmail.store import RunState, Store
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.compact import Wanted, export_compact, settled_cells
from tests.store.databases import add, contents, files

NOTHING = Wanted(curves=(), arrays={})


def test_the_newest_settled_run_of_each_cell_is_chosen(store: Store) -> None:
    add(store, 0)
    newer = add(store, 0, state=RunState.DIVERGED)
    add(store, 0, [0.3], RunState.INTERRUPTED)
    other_seed, other_data = add(store, 1), add(store, 0, dataset_hash="e" * 64)
    add(store, 2, state=RunState.FAILED)
    assert [run.id for run in settled_cells(store.runs())] == [newer, other_seed, other_data]


def test_every_column_and_last_value_is_kept_and_curves_that_are_wanted(store: Store, tmp_path: Path) -> None:
    run_id, _ = add(store, 0, [0.3, 0.2, 0.1]), add(store, 1)
    (run,) = store.runs(ids=[run_id])
    target = tmp_path / "small.db"
    done = export_compact(store.where, target, [run], Wanted(["actor/loss"], {}))
    small = Store.open(target)
    assert small.runs() == [run]
    assert small.latest_metrics([run_id]).equals(store.latest_metrics([run_id]))
    assert small.metrics([run_id], ["actor/loss"]).equals(store.metrics([run_id], ["actor/loss"]))
    assert small.metrics([run_id], ["validation/mode_mse"])["value"].tolist() == [0.1]
    assert small.array_names(run_id) == []
    assert small.artifacts(run_id) == []
    small.close()
    assert (done.runs, done.metrics, done.left_out_metrics) == (1, 3 + 1 + 1 + 2, 2 + 2)
    assert (done.arrays, done.left_out_arrays, done.left_out_artifacts, done.thinned) == (0, 1, 1, 0)
    assert done.size_bytes == target.stat().st_size
    assert check(target) == []


def test_arrays_whole_and_in_part(store: Store, tmp_path: Path) -> None:
    ids = [add(store, seed) for seed in range(3)]
    wanted = Wanted((), {ids[0]: {"test/rollouts": None}, ids[1]: {"test/rollouts": lambda array: array[1:3]}})
    done = export_compact(store.where, tmp_path / "small.db", store.runs(), wanted)
    small = Store.open(tmp_path / "small.db")
    np.testing.assert_array_equal(small.array(ids[0], "test/rollouts"), store.array(ids[0], "test/rollouts"))
    np.testing.assert_array_equal(small.array(ids[1], "test/rollouts"), [2.0, 3.0])
    assert small.array_names(ids[2]) == []
    small.close()
    assert (done.arrays, done.thinned, done.left_out_arrays) == (2, 1, 1)


def test_reading_an_export_makes_and_changes_no_file(store: Store, tmp_path: Path) -> None:
    add(store)
    target = tmp_path / "export" / "small.db"
    export_compact(store.where, target, store.runs(), NOTHING)
    before = files(target.parent)
    assert list(before) == ["small.db"]
    small = Store.open(target)
    assert len(small.runs()) == 1
    assert files(target.parent) == before
    small.close()


def test_an_export_of_an_export_is_the_same(store: Store, tmp_path: Path) -> None:
    add(store)
    export_compact(store.where, tmp_path / "one.db", store.runs(), NOTHING)
    export_compact(tmp_path / "one.db", tmp_path / "two.db", store.runs(), NOTHING)
    assert contents(tmp_path / "one.db") == contents(tmp_path / "two.db")


def test_an_export_overwrites_nothing_and_leaves_nothing_after_a_failure(store: Store, tmp_path: Path) -> None:
    run_id = add(store)
    target = tmp_path / "export" / "small.db"
    export_compact(store.where, target, store.runs(), NOTHING)
    before = files(target.parent)
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        export_compact(store.where, target, store.runs(), NOTHING)
    wanted = Wanted((), {run_id: {"test/rollouts": lambda array: array[9]}})
    with pytest.raises(IndexError):
        export_compact(store.where, tmp_path / "export" / "other.db", store.runs(), wanted)
    assert files(target.parent) == before


KILLED = """
import os, signal, sys
from pathlib import Path
from ssmail.store import Store
from ssmail.store.maintenance import compact
compact._shrink = lambda path: os.kill(os.getpid(), signal.SIGKILL)
compact.export_compact(sys.argv[1], Path(sys.argv[2]), Store.open(sys.argv[1]).runs(), compact.Wanted((), {}))
"""


def test_an_export_that_is_killed_leaves_no_half_file(store: Store, tmp_path: Path) -> None:
    add(store)
    before = contents(store.where)
    target = tmp_path / "small.db"
    assert subprocess.run([sys.executable, "-c", KILLED, store.where, str(target)], check=False).returncode == -9
    assert not target.exists()
    export_compact(store.where, target, store.runs(), NOTHING)
    assert check(target) == []
    assert contents(store.where) == before


def test_merging_a_compact_copy_and_the_whole_keeps_the_whole(store: Store, tmp_path: Path) -> None:
    from ssmail.store.maintenance.merge import Fate, merge

    add(store, 0, [0.3, 0.2, 0.1])
    small = tmp_path / "small" / "small.db"
    export_compact(store.where, small, store.runs(), NOTHING)
    before = contents(store.where)
    assert merge(store.where, small).count(Fate.ALREADY_THERE) == 1
    assert contents(store.where) == before
    assert merge(small, store.where).count(Fate.REPLACED) == 1
    assert contents(small) == before
    assert check(small) == []
