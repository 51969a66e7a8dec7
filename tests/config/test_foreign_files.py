"""Files that are none, and archives that declare more than there is."""

import io
import os
import zipfile
from pathlib import Path

import pytest

from ssmail.config import foreign_files
from ssmail.config.foreign_files import IrregularFileError, is_plain, open_regular, read_whole
from tests.hostile.harness import time_limit


def test_a_regular_file_is_read_also_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"text")
    (tmp_path / "link").symlink_to("file")
    for name in ("file", "link"):
        with open_regular(tmp_path / name) as file:
            assert read_whole(file, 100) == b"text"


def test_nothing_else_is_opened_and_nothing_is_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "link", Path(os.devnull), Path("/dev/zero")):
        with time_limit(5), pytest.raises(IrregularFileError, match="not a regular file"), open_regular(path):
            pass
    for name in ("absent", "a\0b"):
        with pytest.raises(FileNotFoundError), open_regular(tmp_path / name):
            pass


def test_what_is_longer_than_allowed_is_not_read_to_its_end() -> None:
    endless = io.BytesIO(bytes(10 * foreign_files.PIECE))
    assert read_whole(endless, 2 * foreign_files.PIECE) is None
    assert endless.tell() == 2 * foreign_files.PIECE + 1


def test_a_list_of_a_million_members_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign_files, "DIRECTORY", 5000)
    with zipfile.ZipFile(tmp_path / "many.zip", "w") as archive:
        for number in range(100):
            archive.writestr(f"{number:06d}", b"")
    with open_regular(tmp_path / "many.zip") as file, pytest.raises(zipfile.BadZipFile, match="too long"):
        zipfile.ZipFile(file)
    monkeypatch.setattr(foreign_files, "DIRECTORY", 6000)
    with open_regular(tmp_path / "many.zip") as file, zipfile.ZipFile(file) as archive:
        assert len(archive.infolist()) == 100


@pytest.mark.parametrize(("method", "plain"), [("STORED", True), ("DEFLATED", True), ("BZIP2", False), ("LZMA", False)])
def test_only_stored_and_deflated_members_are_plain(method: str, plain: bool) -> None:
    member = zipfile.ZipInfo("name")
    member.compress_type = getattr(zipfile, f"ZIP_{method}")
    assert is_plain(member) == plain
    member.flag_bits |= 1
    assert not is_plain(member)
