"""Databases from strangers: hostile values in every column, mutated files, and tables that are not ssmail's."""

import contextlib
import json
import shutil
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store, arrays
from tests.hostile.harness import cases, hold, mutated, refused

RUN = "{run}"  # in a command: the id of the first run
COMMANDS = (
    ("runs", "list"),
    ("runs", "list", "--format", "table"),
    ("runs", "list", "--json"),
    ("runs", "show", RUN),
    ("runs", "show", RUN, "--format", "table"),
    ("runs", "compare"),
    ("runs", "compare", "--format", "table"),
    ("runs", "export"),
    ("runs", "export", "--format", "json"),
    ("runs", "delete", "--yes", RUN),
    ("db", "info"),
    ("db", "info", "--json"),
    ("db", "check"),
    ("db", "check", "--json"),
    ("db", "backup", "backup.db"),
    ("db", "upgrade"),
    ("db", "export", "--compact", "small.db"),
    ("claims",),
    ("claims", "--format", "table"),
    ("plot", "--out", "figures", "--format", "svg", "fig4"),
    ("plot", "--out", "figures", "--format", "svg", "fig5"),
    ("plot", "--out", "figures", "--format", "svg", "fig9"),
    ("plot", "--out", "figures", "--format", "svg", "training"),
    ("plot", "--out", "figures", "--format", "svg", "forecast"),
    ("plot", "--out", "figures", "--format", "svg", "trajectories", "--run", RUN),
    ("report", "--out", "figures", "--format", "svg"),
    ("train", "--method", "ssail", "--profile", "smoke", "--seeds", "0-1", "--dry-run"),
)
SLOW = ("claims", "plot", "report", "export")
TABLES = ("run", "metric", "metric_latest", "array", "artifact")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a database of two finished runs of one spec, a diverged and an interrupted one."""
    matplotlib.get_configdir(), matplotlib.get_cachedir()  # made now, and not in a case that is watched
    folder = tmp_path_factory.mktemp("original")
    store = Store.open(folder / "ssmail.db")
    ends = (RunState.FINISHED, RunState.FINISHED, RunState.DIVERGED, RunState.INTERRUPTED)
    for seed, state in enumerate(ends):
        spec = build_spec("ssail" if seed != 2 else "gail", "yjunction", "smoke")
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu")
        for epoch in (1, 2):
            values = {"train/mode_mse": 0.1 / epoch, "validation/mode_mse": 0.2, "actor/loss": np.nan}
            writer.epoch(epoch, values)
        if state is RunState.FINISHED:
            writer.final(2, {"test/mode_mse": 0.1, "test/on_lane": 1.0, "test_constant_velocity/mode_mse": 0.3})
            rollouts = np.zeros((1, 2, 3, 2, 2), np.float32)
            names = ("test/expert", "test/lane", "test/centre_lines", "test/rollouts")
            writer.arrays(dict.fromkeys(names, rollouts))
            writer.folder.mkdir(parents=True)
            (writer.folder / "best.pt").write_bytes(b"weights")
            writer.artifact("best.pt")
        writer.finish(state, None if state is RunState.FINISHED else f"it {state}")
    store.close()
    with closing(sqlite3.connect(folder / "ssmail.db", isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    return folder


def columns() -> list[tuple[str, str]]:
    from ssmail.store.schema import metadata

    return [(table, column.name) for table in TABLES for column in metadata.tables[table].columns]


DEEP = "[" * 100_000
VALUES: st.SearchStrategy[Any] = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 1, -1, 2**31, 2**62, 2**63 - 1, -(2**63)]),
    st.floats(),
    st.text(max_size=20),
    st.binary(max_size=20),
    st.sampled_from(
        [
            "paused", "running", "finished", "queued", "nan", "inf", "finite", "ssail", "gail", "mocap", "yjunction",
            "letters", "smoke", "paper", "2026-01-01 00:00:00.000000", "0001-01-01 00:00:00", "9999-12-31 23:59:59",
            "2026-13-01", "2026-01-01 00:00:00+05:00", "now", "../../precious", ".", "/etc/passwd", "-rf", "a" * 32,
            "A" * 32, "x" * 20_000, "x" * 2_000_000, "\x1b[2J", "\ud7ff\u202e", "test/mode_mse", "train/mode_mse",
            "test/rollouts", "<f4", "|O", "<M8[s]", "V4", "f4,f4", "[1]", "[-1]", "[1e9]", "[4294967296, 4294967296]",
            "[1, 2, 3, 2, 2]", "[0]", "{}", "null", "[]", "1", '"x"', "NaN", "{" * 5000, DEEP, "9" * 5000,
            '{"a":' * 500 + "1" + "}" * 500, '{"method":"ssail"}', '{"training":{"epochs":"x"}}',
            b"\xff\xfe", zlib.compress(b""), zlib.compress(bytes(100)), zlib.compress(bytes(10**7)),
        ]
    ),
)  # fmt: skip
SPEC_VALUES = st.one_of(
    VALUES.filter(lambda value: not isinstance(value, bytes)),
    st.integers(10**30, 10**40),
    st.lists(st.integers(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)


def places(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, item in value.items() if isinstance(value, dict) else ():
        yield (*path, key)
        yield from places(item, (*path, key))


def spoil(database: Path, statement: str, *values: Any) -> None:
    """Run a statement; what SQLite itself refuses is left as it was."""
    with (
        closing(sqlite3.connect(database, isolation_level=None)) as connection,
        contextlib.suppress(sqlite3.Error, UnicodeEncodeError),
    ):
        connection.execute(statement, values)


def spoil_spec(database: Path, data: st.DataObject) -> None:
    """Change a value of a stored spec, or remove it; often with the hash that belongs to the new spec."""
    from ssmail.config.spec import spec_hash

    with closing(sqlite3.connect(database)) as connection:
        run, text = connection.execute("SELECT id, spec_json FROM run ORDER BY seed LIMIT 1").fetchone()
    spec = json.loads(text)
    *way, last = data.draw(st.sampled_from(list(places(spec))))
    section = spec
    for key in way:
        section = section[key]
    if data.draw(st.integers(0, 3)):
        section[last] = data.draw(SPEC_VALUES)
    else:
        del section[last]
    if data.draw(st.booleans()):
        with contextlib.suppress(Exception):
            spoil(database, "UPDATE run SET spec_hash = ? WHERE id = ?", spec_hash(json.loads(json.dumps(spec))), run)
    spoil(database, "UPDATE run SET spec_json = ? WHERE id = ?", json.dumps(spec), run)


def first_run(original: Path) -> str:
    with closing(sqlite3.connect(original / "ssmail.db")) as connection:
        return str(connection.execute("SELECT id FROM run ORDER BY seed LIMIT 1").fetchone()[0])


def use(original: Path, database: Path, data: st.DataObject) -> None:
    """Give the database to a command, or merge it into one's own, which stays sound and readable."""
    folder = database.parent
    with contextlib.chdir(folder):
        command = data.draw(st.sampled_from([*(8 * [item for item in COMMANDS if item[0] not in SLOW]), *COMMANDS]))
        if data.draw(st.integers(0, 4)):
            words = [first_run(original) if word == RUN else word for word in command]
            hold(folder, *words, "--db", database)
            return
        own = folder / "own" / "ssmail.db"
        own.parent.mkdir(exist_ok=True)
        if data.draw(st.booleans()):
            shutil.copyfile(original / "ssmail.db", own)
            shutil.copytree(original / "checkpoints", own.parent / "checkpoints")
            spoil(own, "DELETE FROM run WHERE seed < ?", data.draw(st.integers(0, 4)))
        hold(folder, "db", "merge", database, "--db", own)
        check_own(folder, own)


def check_own(folder: Path, own: Path) -> None:
    if own.exists():
        _, out, _ = hold(folder, "db", "check", "--json", "--db", own)
        # files that do not come with a database are another matter
        assert not [item for item in json.loads(out) if item["check"] not in ("checkpoints", "folders", "orphans")], out
        code, _, err = hold(folder, "runs", "list", "--db", own)
        assert code == 0, err
        assert "damaged" not in err, err


def start(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("case")
    shutil.copyfile(original / "ssmail.db", folder / "ssmail.db")
    return folder / "ssmail.db"


@cases(quick=12, fuzz=1600)
@given(data=st.data())
def test_hostile_cells(original: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    database = start(original, tmp_path_factory)
    for _ in range(data.draw(st.integers(1, 3))):
        table, column = data.draw(st.sampled_from(columns()))
        where = data.draw(st.sampled_from(["", " WHERE rowid = 1", " WHERE rowid % 2"]))
        if "metric" in table:
            where = data.draw(st.sampled_from(["", " WHERE step = 2", " WHERE name LIKE 'test%'"]))
        spoil(database, f"UPDATE OR REPLACE {table} SET {column} = ?{where}", data.draw(VALUES))
    use(original, database, data)


@cases(quick=6, fuzz=500)
@given(data=st.data())
def test_hostile_specs(original: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    database = start(original, tmp_path_factory)
    spoil_spec(database, data)
    use(original, database, data)


@cases(quick=6, fuzz=700)
@given(seed=st.integers(0, 2**32), data=st.data())
def test_mutated_files(
    original: Path, tmp_path_factory: pytest.TempPathFactory, seed: int, data: st.DataObject
) -> None:
    database = start(original, tmp_path_factory)
    database.write_bytes(mutated(database.read_bytes(), seed))
    use(original, database, data)


SCHEMAS = st.one_of(
    st.tuples(st.just("DROP TABLE {}"), st.sampled_from([*TABLES, "alembic_version"])),
    st.tuples(st.just("ALTER TABLE {} RENAME TO other"), st.sampled_from([*TABLES, "alembic_version"])),
    st.tuples(st.just("ALTER TABLE {0[0]} DROP COLUMN {0[1]}"), st.sampled_from(columns())),
    st.tuples(st.just("ALTER TABLE {0[0]} RENAME COLUMN {0[1]} TO other"), st.sampled_from(columns())),
    st.tuples(st.just("ALTER TABLE {} ADD COLUMN more TEXT"), st.sampled_from(TABLES)),
    st.tuples(st.just("CREATE TABLE loose AS SELECT * FROM {0};; DROP TABLE {0};; ALTER TABLE loose RENAME TO {0}"),
              st.sampled_from(TABLES)),
    st.tuples(st.just("ALTER TABLE {0} RENAME TO other;; CREATE VIEW {0} AS SELECT * FROM other"),
              st.sampled_from(TABLES)),
    st.tuples(st.just("CREATE TRIGGER t AFTER UPDATE ON {} BEGIN DELETE FROM run; END"), st.sampled_from(TABLES)),
    st.tuples(st.just("CREATE TRIGGER t BEFORE INSERT ON {} BEGIN SELECT raise(ABORT, 'no\n\x1b'); END"),
              st.sampled_from(TABLES)),
    st.tuples(st.just("CREATE TABLE {} (x)"), st.sampled_from(['"; rm -r ~"', "more", "'\x1b[2J'"])),
    st.tuples(st.just("UPDATE alembic_version SET version_num = {}"),
              st.sampled_from(["NULL", "1", "'0002'", "x'00'", "''"])),
    st.tuples(st.just("{}"), st.sampled_from(["DELETE FROM alembic_version", "PRAGMA user_version = 7", "VACUUM",
                                              "PRAGMA application_id = 5", "DELETE FROM run", "DELETE FROM metric"])),
)  # fmt: skip


@cases(quick=6, fuzz=400)
@given(change=SCHEMAS, data=st.data())
def test_other_tables(
    original: Path, tmp_path_factory: pytest.TempPathFactory, change: Any, data: st.DataObject
) -> None:
    database = start(original, tmp_path_factory)
    statement, subject = change
    for part in statement.format(subject).split(";; "):
        spoil(database, part)
    use(original, database, data)


@pytest.mark.parametrize("command", [*COMMANDS, ("db", "merge")], ids=" ".join)
def test_every_command_takes_the_sound_database(original: Path, tmp_path: Path, command: tuple[str, ...]) -> None:
    """The control: without a mutation, nothing is said of damage."""
    database = tmp_path / "ssmail.db"
    shutil.copyfile(original / "ssmail.db", database)
    shutil.copytree(original / "checkpoints", tmp_path / "checkpoints")
    with contextlib.chdir(tmp_path):
        if command == ("db", "merge"):
            shutil.copyfile(original / "ssmail.db", tmp_path / "other.db")
            command = ("db", "merge", "other.db")
        words = [first_run(original) if word == RUN else word for word in command]
        code, out, err = hold(tmp_path, *words, "--db", database)
    assert code == 0 or command[0] in ("plot", "report"), (code, out, err)
    assert "damaged" not in out + err


REFERENCE = Path(__file__).parents[2] / "results" / "reference" / "reference.db"
UNFIT = {
    "flat": lambda array: array.reshape(-1),
    "scalar": lambda array: np.array(1.0),
    "empty": lambda array: array[..., :0] if array.ndim else array,
    "nan": lambda array: array * np.float32("nan"),
}


@pytest.mark.parametrize("unfit", UNFIT)
@pytest.mark.filterwarnings("ignore")
def test_arrays_that_do_not_fit_what_is_drawn(unfit: str, tmp_path: Path) -> None:
    """Each is sound by itself, so it shows only where it is used."""
    matplotlib.get_configdir(), matplotlib.get_cachedir()
    database = tmp_path / "ssmail.db"
    shutil.copyfile(REFERENCE, database)
    with closing(sqlite3.connect(database)) as connection, connection:
        for row, *stored in connection.execute("SELECT rowid, dtype, shape, data FROM array").fetchall():
            new = arrays.encode(np.asarray(UNFIT[unfit](arrays.decode(*stored))))
            connection.execute("UPDATE array SET dtype = :dtype, shape = :shape, data = :data WHERE rowid = :row",
                               {**new, "row": row})  # fmt: skip
    for figure in ("fig2", "fig5"):
        sentence = refused(tmp_path, "plot", "--out", tmp_path / "out", figure, "--db", database)
        assert f"what is stored of {figure} does not fit together" in sentence
    code, out, _ = hold(tmp_path, "claims", "--db", database)
    assert (code in (0, 3), len(out.splitlines()) >= 9) == (True, True), (code, out)
