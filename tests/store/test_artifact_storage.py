"""Objects in a shared place: whole or absent, verified when read, named by nothing that a database says."""

import errno
import hashlib
import os
import sys
import uuid
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.registry import _registry

from ssmail.errors import InputError, SsmailError
from ssmail.store import ArtifactRow, RunState, RunWriter, Store
from ssmail.store.artifact_storage import (
    NOT_GIVEN,
    AlteredObjectError,
    ArtifactStorage,
    recorded_fault,
    storage_of,
)
from ssmail.store.maintenance.checks import check
from ssmail.store.maintenance.merge import merge
from tests.store.databases import add, change, files

RUN, CONTENT = "a1" * 16, b"a checkpoint"
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(params=["folder", "file://", "memory://"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    folder = str(tmp_path / "shared" / "artifacts")
    return {"folder": folder, "file://": f"file://{folder}", "memory://": f"memory://{uuid.uuid4().hex}"}[request.param]


def row(run_id: str = RUN, sha256: str = SHA256, size: int = len(CONTENT)) -> ArtifactRow:
    return ArtifactRow(run_id, "last.pt", Path("/nowhere") / run_id / sha256, sha256, size)


def objects(place: str) -> dict[str, bytes]:
    """Everything below the place, by its path there, hidden files too."""
    fs, root = fsspec.url_to_fs(place)
    return {path[len(root) + 1 :]: fs.cat_file(path) for path in fs.find(root)}


def overwrite(place: str, content: bytes) -> None:
    fs, root = fsspec.url_to_fs(place)
    fs.pipe_file(f"{root}/{RUN}/{SHA256}", content)


def test_an_object_has_the_name_of_its_content(place: str) -> None:
    storage = ArtifactStorage(place)
    assert storage.read(row()) is None
    assert not storage.has(row())
    assert storage.put(RUN, CONTENT) == SHA256
    assert objects(place) == {f"{RUN}/{SHA256}": CONTENT}
    assert (storage.has(row()), storage.read(row())) == (True, CONTENT)
    assert storage.read(row(run_id="b2" * 16)) is None  # objects are not shared among runs
    storage.remove(RUN, [SHA256, "0" * 64, "../x"])
    assert objects(place) == {}
    storage.remove(RUN, [SHA256])


def test_an_object_that_is_there_is_kept_and_a_truncated_one_written_again(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = ArtifactStorage(place)
    storage.put(RUN, CONTENT)
    overwrite(place, CONTENT[:-1])
    storage.put(RUN, CONTENT)
    assert objects(place) == {f"{RUN}/{SHA256}": CONTENT}
    monkeypatch.setattr(storage._files, "write", None)
    storage.put(RUN, CONTENT)


@pytest.mark.parametrize("content", [b"", CONTENT[:-1], b"A checkpoint", CONTENT + b"!"])
def test_other_content_is_noticed(place: str, content: bytes) -> None:
    storage = ArtifactStorage(place)
    storage.put(RUN, CONTENT)
    overwrite(place, content)
    with pytest.raises(AlteredObjectError, match=f"{RUN}/{SHA256} has been altered since it was recorded"):
        storage.read(row())
    assert recorded_fault(row(), storage) == "altered"


@pytest.mark.parametrize("place", ["folder", "memory://"], indirect=True)
@pytest.mark.parametrize("moment", ["writing", "renaming"])
def test_an_interrupted_write_leaves_nothing_under_the_name(
    place: str, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = ArtifactStorage(place)

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt  # after what has been written so far

    if "://" in place:
        method = "pipe_file" if moment == "writing" else "mv"
        fs = storage._files._fs  # type: ignore[attr-defined]
        monkeypatch.setattr(fs, method, stop)
    else:
        patched = (Path, "write_bytes") if moment == "writing" else (Path, "replace")
        monkeypatch.setattr(*patched, stop)
    with pytest.raises(KeyboardInterrupt):
        storage.put(RUN, CONTENT)
    monkeypatch.undo()
    assert objects(place) == {}
    assert not storage.has(row())
    storage.put(RUN, CONTENT)
    assert storage.has(row())  # negative control


@pytest.mark.parametrize(
    "sha256", ["", "x", "../" * 20 + "etc/hostname", SHA256.upper(), SHA256 + "\n", "/etc/hostname"]
)
def test_no_stored_text_but_a_hash_becomes_part_of_a_path(tmp_path: Path, sha256: str) -> None:
    storage = ArtifactStorage(str(tmp_path))
    assert storage.read(row(sha256=sha256)) is None
    assert not storage.has(row(sha256=sha256))
    storage.remove(RUN, [sha256])
    with pytest.raises(InputError, match="is no run id"):
        storage.read(row(run_id="../precious"))


def test_links_pipes_and_folders_are_no_objects(tmp_path: Path) -> None:
    storage = ArtifactStorage(str(tmp_path))
    target = tmp_path / "elsewhere"
    target.write_bytes(CONTENT)
    (tmp_path / RUN).mkdir()
    name = tmp_path / RUN / SHA256
    name.symlink_to(target)
    with pytest.raises(SsmailError):
        storage.read(row())
    name.unlink()
    os.mkfifo(name)
    with pytest.raises(AlteredObjectError):
        storage.read(row())
    name.unlink()
    name.mkdir()
    with pytest.raises(AlteredObjectError):
        storage.read(row())


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (" ", "takes a folder or a URL"),
        (
            "nosuch://me:SECRET@host/x",
            r"nosuch://me:\*\*\*@host/x cannot be used for artifacts .Protocol not known: nosuch",
        ),
        ("memory://a[b]", "reads as a pattern"),
        ("hdfs://me:SECRET@host/x", r"hdfs://me:\*\*\*@host/x"),
    ],
)
def test_unusable_places_are_a_sentence_without_the_password(place: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        ArtifactStorage(place)
    assert "SECRET" not in str(caught.value)


def test_a_missing_driver_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(_registry, "s3", raising=False)
    with pytest.raises(InputError, match=r"no driver for the URL s3://bucket/x is installed; run `pip install s3fs`"):
        ArtifactStorage("s3://bucket/x")


def test_a_place_that_cannot_be_written_to_is_noticed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = ArtifactStorage(str(tmp_path / "shared"))
    storage.require_writable()
    assert objects(storage.place) == {}  # nothing remains

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"shared cannot be written to \(No space left on device\); choose another pl"):
        storage.require_writable()


def test_the_place_comes_from_the_user_alone(store: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert (store.storage, storage_of(None)) == (None, None)
    monkeypatch.setenv("SSMAIL_ARTIFACTS", str(tmp_path / "a"))
    assert Store.open(store.where).storage.place == str(tmp_path / "a")  # type: ignore[union-attr]
    assert Store.open(store.where, artifacts=str(tmp_path / "b")).storage.place == str(tmp_path / "b")  # type: ignore[union-attr]


# -- databases whose runs keep their checkpoints there ---------------------------------------------------------------


@pytest.fixture(params=["folder", "memory"])
def there(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "shared") if request.param == "folder" else f"memory://{uuid.uuid4().hex}"


@pytest.fixture
def shared(store: Store, there: str) -> Store:
    return Store.open(store.where, artifacts=there)


@pytest.fixture
def stored(shared: Store) -> str:
    """A finished run with two objects."""
    run_id = add(shared, state=RunState.RUNNING, checkpoints={})
    writer = RunWriter(shared._engine, shared.checkpoint_root, run_id, shared.run(run_id).owner, storage=shared.storage)
    writer.store_objects({"best.pt": b"best", "last.pt": b"first"})
    writer.store_objects({"last.pt": CONTENT})
    writer.final(2, {"test/mode_mse": 0.1})
    writer.finish(RunState.FINISHED)
    return run_id


def test_superseded_objects_are_removed_and_nothing_else(shared: Store, stored: str, there: str) -> None:
    assert set(objects(there).values()) == {b"best", CONTENT}
    assert {item.name: item.by_content for item in shared.artifacts(stored)} == {"best.pt": True, "last.pt": True}
    assert not shared.checkpoint_root.exists()


def test_an_object_whose_record_fails_stays(shared: Store, there: str) -> None:
    """Another process of the run, which owns it now, may have written the same one."""
    run_id = add(shared, state=RunState.RUNNING, checkpoints={})
    writer = RunWriter(shared._engine, shared.checkpoint_root, run_id, "another owner", storage=shared.storage)
    with pytest.raises(SsmailError, match="resumed by another process"):
        writer.store_objects({"last.pt": CONTENT})
    assert list(objects(there).values()) == [CONTENT]


def test_delete_removes_what_the_run_recorded_where_it_is_given(shared: Store, stored: str, there: str) -> None:
    other = "b2" * 16
    shared.storage.put(other, CONTENT)  # type: ignore[union-attr]
    kept = objects(there)
    copy = Path(shared.where).with_name("copy.db")
    merge(copy, shared.where)
    without = Store.open(copy)
    without.delete([stored])
    assert objects(there) == kept  # negative control: no place was given
    shared.delete([stored])
    assert list(objects(there)) == [f"{other}/{SHA256}"]


def test_check_reads_the_objects(shared: Store, stored: str, there: str) -> None:
    assert check(shared.where, there) == []
    (best, last) = check(shared.where)
    assert NOT_GIVEN in best.problem
    assert last.remedy == "give that place with --artifacts"
    fs, root = fsspec.url_to_fs(there)
    fs.pipe_file(f"{root}/{stored}/{SHA256}", b"A checkpoint")
    (problem,) = check(shared.where, there)
    assert problem.problem == f"the checkpoint last.pt of run {stored[:8]} is altered"
    assert f"{stored}/{SHA256}, or delete the run" in problem.remedy
    fs.rm_file(f"{root}/{stored}/{SHA256}")
    assert "is missing" in check(shared.where, there)[0].problem


def test_a_merge_puts_files_there_and_leaves_objects_where_they_are(
    shared: Store, stored: str, there: str, tmp_path: Path
) -> None:
    theirs = Store.open(tmp_path / "theirs" / "ssmail.db")
    local = add(theirs, seed=7, checkpoints={"best.pt": b"local best", "last.pt": b"local last"})
    target = tmp_path / "both" / "ssmail.db"
    for other in (theirs, shared):
        done = merge(target, other.where, there)
        assert done.without_checkpoints == ()
    assert sorted(objects(there).values()) == sorted([b"best", CONTENT, b"local best", b"local last"])
    assert check(target, there) == []
    for file in (target.parent / "checkpoints").rglob("*.pt"):
        file.unlink()  # the files beside the database are not needed any more
    assert check(target, there) == []
    assert {problem.subject for problem in check(target)} == {stored, local}  # negative control


def test_a_record_that_names_another_hash_is_no_object(shared: Store, stored: str, tmp_path: Path) -> None:
    """The path of a record is only compared; files that the records of a stranger name are not looked at."""
    change(shared.where, "UPDATE artifact SET path = ? WHERE name = 'last.pt'", f"{stored}/{'0' * 64}")
    (last,) = (item for item in shared.artifacts(stored) if item.name == "last.pt")
    assert not last.by_content
    change(shared.where, "UPDATE artifact SET path = ?, sha256 = ?", "../../secret", "../../secret")
    assert all(item.path is None and not item.by_content for item in shared.artifacts(stored))
    assert {problem.problem.rpartition(" is ")[2] for problem in check(shared.where, "memory://none")} == {
        "recorded in another folder"
    }
    assert files(tmp_path / "results" / "checkpoints") == {}
