import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from ssmail.data.atomic_file import PATIENCE, atomic_write


def test_the_folder_is_made_and_the_file_replaced(tmp_path: Path) -> None:
    target = tmp_path / "new" / "file.txt"
    for text in ("old", "new"):
        with atomic_write(target) as partial:
            partial.write_text(text)
            assert partial.parent == target.parent
        assert target.read_text() == text
    assert list(target.parent.iterdir()) == [target]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "file.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(target) as partial:  # noqa: PT012
        partial.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appeared_meanwhile_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    def no_links(*_: object) -> None:
        raise OSError("no hard links here")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    target = tmp_path / "file.txt"
    with atomic_write(target, overwrite=False) as partial:
        partial.write_text("first")
    with pytest.raises(FileExistsError), atomic_write(target, overwrite=False) as partial:
        partial.write_text("second")
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]


def _write_for_ever(target: Path, ready: Connection) -> None:
    with atomic_write(target) as partial:
        partial.write_text("half")
        ready.send(None)
        time.sleep(600)


def _writer(target: Path) -> BaseProcess:
    """A process that is in the middle of writing `target`."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_write_for_ever, args=(target, there))
    process.start()
    here.recv()
    return process


def test_what_a_killed_process_left_is_deleted_and_no_other_process_is_disturbed(tmp_path: Path) -> None:
    killed, running = _writer(tmp_path / "a.npz"), _writer(tmp_path / "b.npz")
    try:
        killed.kill()
        killed.join()
        assert len(list(tmp_path.iterdir())) == 2
        with atomic_write(tmp_path / "c.npz") as partial:
            partial.write_text("new")
            with atomic_write(tmp_path / "d.npz") as second:
                second.write_text("new")
        left = sorted(path.name for path in tmp_path.iterdir())
        assert left[0].startswith(".b.npz.")
        assert left[1:] == ["c.npz", "d.npz"]
    finally:
        running.kill()
        running.join()
    with atomic_write(tmp_path / "c.npz") as partial:
        partial.write_text("newer")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.npz", "d.npz"]


def test_temporary_files_of_other_machines_and_older_versions_are_deleted_after_a_day(tmp_path: Path) -> None:
    names = {
        *(".x.db.0123abcd.partial", ".x.db.0123abcd.partial-wal", ".m.npz.4711.npz"),
        f".m.npz.00000000-{os.getpid()}-0123abcd.partial",
    }
    others = {"m.npz", ".partial", ".notes.partial", ".m.npz", "m.npz.4711.npz", "x.db.0123abcd.partial"}
    for name in names | others:
        (tmp_path / name).write_text("")
    (tmp_path / ".folder.0123abcd.partial").mkdir()

    def left() -> set[str]:
        with atomic_write(tmp_path / "new") as partial:
            partial.write_text("")
        return {path.name for path in tmp_path.iterdir() if path.is_file()} - {"new"}

    assert left() == names | others
    for name in names | others:
        os.utime(tmp_path / name, (0, time.time() - PATIENCE - 60))
    assert left() == others


@pytest.mark.parametrize("kind", ["folder", "pipe", "device"])
def test_only_regular_files_are_replaced(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "target"
    if kind == "folder":
        target.mkdir()
    elif kind == "pipe":
        os.mkfifo(target)
    else:
        target.symlink_to(os.devnull)
    before = target.lstat().st_mode
    with pytest.raises(OSError, match="folder, pipe or device"), atomic_write(target) as partial:
        partial.write_text("new")
    assert target.lstat().st_mode == before
    assert list(tmp_path.iterdir()) == [target]
