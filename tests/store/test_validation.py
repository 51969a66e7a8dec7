"""A damaged row is left out, named with its id, and hides no other."""

import json
import shlex
import sqlite3
import sys
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import spec_hash
from ssmail.errors import InputError
from ssmail.store import RunState, Store
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.merge import merge
from ssmail.store.schema import is_run_id
from tests.store.databases import add, change, contents

SPEC = json.loads(build_spec("ssail", "yjunction", "smoke").as_json())


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("0a" * 16, True),
        *(
            (value, False)
            for value in ("0A" * 16, "0a" * 16 + "\n", "../../precious", ".", "", "a" * 31, "/" + "a" * 31)
        ),
        *((value, False) for value in (None, 7, b"0a" * 16)),
    ],
)
def test_run_ids(value: object, expected: bool) -> None:
    assert is_run_id(value) is expected


def spec(**changes: Any) -> str:
    return json.dumps({**SPEC, **changes})


DAMAGE: dict[str, tuple[str, Any]] = {
    "state": ("state", "paused"),
    "no state": ("state", b"running"),
    "no date": ("started", "yesterday"),
    "number for a date": ("heartbeat", 7),
    "bytes for a date": ("finished", b"2026-01-01"),
    "another zone": ("started", "2026-01-01 00:00:00+05:00"),
    "year 1": ("heartbeat", "0001-01-01 00:00:00"),
    "text for a seed": ("seed", "x"),
    "half a seed": ("seed", 0.5),
    "negative seed": ("seed", -1),
    "text for resumes": ("resumes", "many"),
    "bytes for a text": ("host", b"h"),
    "not UTF-8": ("host", "CAST(x'ff' AS TEXT)"),
    "infinite seconds": ("wall_seconds", float("inf")),
    "text for memory": ("peak_memory_bytes", "much"),
    "neither true nor false": ("git_dirty", 2),
    "long text": ("device", "x" * 20_000),
    "no JSON": ("spec_json", "gone"),
    "a list": ("spec_json", "[]"),
    "NaN": ("spec_json", spec(profile=float("nan"))),
    "deep": ("spec_json", "[" * 100_000),
    "deep, and valid JSON": ("spec_json", spec(more=json.loads("[" * 500 + "]" * 500))),
    "many digits": ("spec_json", '{"a":' + "9" * 5000 + "}"),
    "large number": ("spec_json", spec(more=10**30)),
    "huge spec": ("spec_json", spec(more=["x"] * 300_000)),
    "section of text": ("spec_json", spec(model="x")),
    "list for a section": ("spec_json", spec(self_supervision=[1])),
    "text for epochs": ("spec_json", spec(training={**SPEC["training"], "epochs": "3"})),
    "no training": ("spec_json", spec(training=None)),
    "spec of another method": ("spec_json", spec(method="gail")),
    "half a character": ("spec_json", spec(more="\ud800")),
}


def damaged_and_sound(store: Store, column: str, value: Any) -> tuple[str, str]:
    """The ids of a run with this value in the column, and of another run."""
    damaged, sound = add(store, 0, checkpoints={}), add(store, 1, checkpoints={})
    expression = value if isinstance(value, str) and value.startswith("CAST") else "?1"
    change(store.where, f"UPDATE run SET {column} = {expression} WHERE id = ?2", value, damaged)
    return damaged, sound


@pytest.mark.parametrize(("column", "value"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_run_is_left_out_everywhere(column: str, value: Any, store: Store, tmp_path: Path) -> None:
    damaged, sound = damaged_and_sound(store, column, value)
    assert [run.id for run in store.runs()] == [sound]
    (row,) = store.damaged
    assert (row.table, row.run_id) == ("run", damaged)
    assert len(row.reason) < 100
    store.mark_stale()
    store.find_cell(spec_hash(SPEC), 0)
    with pytest.raises(InputError, match=f"run {damaged[:8]} is damaged"):
        store.runs(ids=[damaged])
    with pytest.raises(InputError, match=f"run {damaged[:8]} is damaged"):
        store.resume_run(damaged, 0)
    (problem,) = check(store.where)
    assert (problem.subject, problem.check in ("rows", "spec")) == (damaged, True)
    assert problem.remedy == f"delete the run (`ssmail runs delete {damaged[:8]}`) and train it again"

    own = Store.open(tmp_path / "own" / "ssmail.db")
    done = merge(own.where, store.where)
    assert [run.id for run in own.runs()] == [sound]
    assert [problem.subject for problem in done.damaged] == [damaged]
    assert check(own.where) == []
    store.delete([damaged])  # the remedy helps
    assert check(store.where) == []


@pytest.mark.parametrize("run_id", ["../../precious", ".", "", None, b"bytes", "A" * 32, 7, "a" * 32 + "\n"])
def test_an_id_that_is_none_is_damage_and_the_remedy_removes_it(run_id: Any, store: Store) -> None:
    damaged, sound = damaged_and_sound(store, "error", None)
    with closing(sqlite3.connect(store.where)) as connection, connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = replace(sql, 'VARCHAR(32) NOT NULL', 'VARCHAR(32)')")
    for table, column in (("run", "id"), ("array", "run_id")):
        change(store.where, f"UPDATE {table} SET {column} = ? WHERE {column} = ?", run_id, damaged)
    for table in ("metric", "metric_latest"):
        change(store.where, f"DELETE FROM {table} WHERE run_id = ?", damaged)
    assert [run.id for run in store.runs()] == [sound]
    (problem,) = [problem for problem in check(store.where) if problem.check == "rows"]
    assert "its id is " in problem.problem
    _, path, sql = shlex.split(problem.remedy.split("`")[1])
    assert sql.startswith("PRAGMA foreign_keys = ON; DELETE FROM run WHERE typeof(id)")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(sql)
    assert not [problem for problem in check(store.where) if problem.check == "rows"]
    assert [run.id for run in store.runs()] == [sound]


@pytest.mark.parametrize(
    "changes",
    [{"method": "later", "new": 1}, {"model": {**SPEC["model"], "new": [1, [2]]}}, {"wasserstein": None}],
)
def test_specs_of_other_versions_are_sound(changes: dict[str, Any], store: Store) -> None:
    run = add(store)
    values = {**SPEC, **changes}
    del values["evaluation"]
    change(store.where, "UPDATE run SET spec_json = ?, method = ?", json.dumps(values), values["method"])
    assert [row.id for row in store.runs()] == [run]
    assert store.damaged == set()


METRICS: dict[str, tuple[str, Any]] = {
    "text": ("value", "much"),
    "infinite": ("value", float("inf")),
    "nothing": ("value", None),
    "unknown kind": ("kind", "odd"),
    "number that is none": ("kind", "nan"),
    "bytes": ("name", b"name"),
    "long": ("name", "x" * 20_000),
    "negative": ("step", -1),
    "large": ("step", 2**40),
    "text for a step": ("step", "second"),
}


@pytest.mark.parametrize("table", ["metric", "metric_latest"])
@pytest.mark.parametrize(("column", "value"), METRICS.values(), ids=METRICS)
def test_a_damaged_value_of_a_metric_is_left_out(
    table: str, column: str, value: Any, store: Store, tmp_path: Path
) -> None:
    damaged, sound = add(store, 0, checkpoints={}), add(store, 1, checkpoints={})
    where = "run_id = ? AND name = 'validation/mode_mse' AND step = 2"
    change(store.where, f"UPDATE {table} SET {column} = ? WHERE {where}", value, damaged)
    read = store.metrics if table == "metric" else store.latest_metrics
    frame, other = read([damaged]), read([sound])
    assert len(frame) == len(other) - 1
    ((row),) = store.damaged
    assert (row.table, row.run_id) == (table, damaged)
    found = check(store.where)
    assert {problem.subject for problem in found} == {damaged}
    assert {"metrics" if table == "metric" else "latest metrics"} <= {problem.check for problem in found}
    own = Store.open(tmp_path / "own" / "ssmail.db")
    assert [problem.subject for problem in merge(own.where, store.where).damaged] == [damaged]
    assert [run.id for run in own.runs()] == [sound]
    assert check(own.where) == []


ARRAYS: dict[str, tuple[str, Any]] = {
    "no zlib": ("data", b"\x00"),
    "more": ("data", zlib.compress(bytes(1000))),
    "less": ("data", zlib.compress(bytes(3))),
    "cut": ("data", zlib.compress(bytes(range(32)))[:-2]),
    "appended": ("data", zlib.compress(bytes(32)) + b"more"),
    "text": ("data", "data"),
    "a number": ("data", 10**12),
    "objects": ("dtype", "|O"),
    "fields": ("dtype", "f4,f4"),
    "time": ("dtype", "<M8[s]"),
    "no dtype": ("dtype", "<f3"),
    "bytes for a dtype": ("dtype", b"<f4"),
    "negative": ("shape", "[-4]"),
    "unknown": ("shape", "[-1]"),
    "huge": ("shape", "[4294967296, 4294967296]"),
    "huge and empty": ("shape", "[0, 4611686018427387904, 4]"),
    "fraction": ("shape", "[4.0]"),
    "true": ("shape", "[true, 4]"),
    "no list": ("shape", "4"),
    "no JSON": ("shape", "[" * 300),
    "many": ("shape", json.dumps([1] * 100)),
    "other": ("shape", "[5]"),
}


@pytest.mark.parametrize(("column", "value"), ARRAYS.values(), ids=ARRAYS)
def test_a_damaged_array_is_refused_by_name(column: str, value: Any, store: Store, tmp_path: Path) -> None:
    damaged, sound = add(store, 0, checkpoints={}), add(store, 1, checkpoints={})
    change(store.where, f"UPDATE array SET {column} = ? WHERE run_id = ?", value, damaged)
    with pytest.raises(InputError, match=rf"the array test/rollouts of run {damaged[:8]} cannot be read: its? .*; `ss"):
        store.array(damaged, "test/rollouts")
    assert store.array(sound, "test/rollouts").shape == (4,)
    (problem,) = check(store.where)
    assert (problem.check, problem.subject) == ("arrays", damaged)
    own = Store.open(tmp_path / "own" / "ssmail.db")
    assert [problem.subject for problem in merge(own.where, store.where).damaged] == [damaged]
    assert [run.id for run in own.runs()] == [sound]


def test_a_bomb_is_not_unpacked(store: Store) -> None:
    """Four megabytes that unpack to four gigabytes, whatever the row says of their size."""
    import resource

    run = add(store)
    packer = zlib.compressobj(9)
    head = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    bomb = head + 256 * (packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH))  # each part stands alone
    assert len(bomb) < 5_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for shape in ("[4]", "[1073741824]", "[4294967296]"):
        change(store.where, "UPDATE array SET data = ?, shape = ?, dtype = '<f4' WHERE run_id = ?", bomb, shape, run)
        with pytest.raises(InputError, match="cannot be read"):
            store.array(run, "test/rollouts")
        assert [problem.check for problem in check(store.where)] == ["arrays"]
    unit = 1024 if sys.platform != "darwin" else 1
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * unit < 100_000_000


@pytest.mark.parametrize(
    ("column", "value"), [("size_bytes", "x"), ("size_bytes", -1), ("path", b"x"), ("sha256", 7.5)]
)
def test_a_damaged_artifact_is_left_out(column: str, value: Any, store: Store, tmp_path: Path) -> None:
    run = add(store)
    assert len(store.artifacts(run)) == 1
    expression = "CAST(x'ff' AS BLOB)" if column == "sha256" else "?"
    values = () if column == "sha256" else (value,)
    change(store.where, f"UPDATE artifact SET {column} = {expression}", *values)
    assert store.artifacts(run) == []
    assert [problem.check for problem in check(store.where)] == ["checkpoints"]
    own = Store.open(tmp_path / "own" / "ssmail.db")
    assert [problem.subject for problem in merge(own.where, store.where).damaged] == [run]
    assert own.runs() == []


def test_a_run_that_contradicts_itself_does_not_enter(store: Store, tmp_path: Path) -> None:
    run = add(store)
    change(store.where, "UPDATE run SET spec_hash = '0123456789abcdef'")
    own = Store.open(tmp_path / "own" / "ssmail.db")
    (problem,) = merge(own.where, store.where).damaged
    assert (problem.check, problem.subject) == ("spec", run)
    assert own.runs() == []


def test_a_damaged_run_at_home_keeps_its_place(store: Store, tmp_path: Path) -> None:
    """Its id may come again, from a sound copy: nothing stored is lost before the user deletes it."""
    run = add(store, checkpoints={})
    own = Store.open(tmp_path / "own" / "ssmail.db")
    merge(own.where, store.where)
    change(own.where, "UPDATE run SET state = 'paused'")
    before = contents(own.where)
    (problem,) = merge(own.where, store.where).damaged
    assert (problem.subject, "merged into" in problem.problem) == (run, True)
    assert contents(own.where) == before
    own.delete([run])
    assert merge(own.where, store.where).damaged == ()
    assert [row.state for row in own.runs()] == [RunState.FINISHED]


@pytest.mark.parametrize(
    "statement",
    [
        "ALTER TABLE run DROP COLUMN owner",
        "ALTER TABLE metric ADD COLUMN more TEXT",
        "ALTER TABLE artifact RENAME TO other",
        "ALTER TABLE array RENAME COLUMN data TO content",
    ],
)
def test_other_tables_are_refused(statement: str, store: Store) -> None:
    add(store)
    store.close()
    change(store.where, statement)
    for use in (Store.open, check):
        with pytest.raises(InputError, match="does not have the columns that ssmail gives it"):
            use(store.where)


def test_a_table_whose_keys_may_repeat_is_refused(store: Store) -> None:
    add(store)
    store.close()
    for statement in (
        "CREATE TABLE loose AS SELECT * FROM metric",
        "DROP TABLE metric",
        "ALTER TABLE loose RENAME TO metric",
    ):
        change(store.where, statement)
    with pytest.raises(InputError, match="the table metric of"):
        Store.open(store.where)
