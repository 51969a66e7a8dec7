"""Folders and zip files that hold a subject, and some that pretend to."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from ssmail.data.mocap import source
from ssmail.data.mocap.source import find_subject, open_source
from ssmail.errors import InputError


def write_folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, contents in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(contents)
    return path


def write_zip(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path.with_suffix(".zip"), "w", zipfile.ZIP_DEFLATED) as archive:
        for name, contents in files.items():
            archive.writestr(name, contents)
    return path.with_suffix(".zip")


Write = Callable[[Path, dict[str, bytes]], Path]
both = pytest.mark.parametrize("write", [write_folder, write_zip])


@both
@pytest.mark.parametrize(
    ("skeleton", "motion"),
    [("35.asf", "35_01.amc"), ("a/b/35.ASF", "c/35_1.AMC"), ("035.Asf", "all asfamc/subjects/35/035_001.amc")],
)
def test_files_are_found_anywhere(tmp_path: Path, write: Write, skeleton: str, motion: str) -> None:
    others = ["35_02.amc", "135.asf", "35_01.amc.txt", "__MACOSX/._35_01.amc", "x35_01.amc", "36_01.amc", "35.asf/x"]
    files = dict.fromkeys(others if skeleton != "35.asf" else others[:-1], b"other")
    path = write(tmp_path / "set", files | {skeleton: b"bones", motion: b"frames"})
    with open_source(path) as opened:
        found = find_subject(opened, 35, [1, 3])
        assert (opened.read(found.skeleton), found.trials) == (b"bones", {1: motion})
        assert opened.read(motion) == b"frames"


@both
def test_two_files_for_one_trial(tmp_path: Path, write: Write) -> None:
    names = ("35.asf", "x/35_01.amc", "y/35_1.AMC", "35_02.amc", "z/35_02.amc")
    path = write(tmp_path / "set", dict.fromkeys(names, b"text"))
    with open_source(path) as opened:
        with pytest.raises(InputError, match=r"trial 01 of subject 35 in x/35_01\.amc and y/35_1\.AMC; leave one"):
            find_subject(opened, 35, [1])
        assert find_subject(opened, 35, [3]).trials == {}
    path = write(tmp_path / "other", dict.fromkeys(("35.asf", "old/35.asf"), b"text"))
    with open_source(path) as opened, pytest.raises(InputError, match=r"the skeleton .* in 35\.asf and old/35\.asf"):
        find_subject(opened, 35, [1])


@both
def test_no_skeleton(tmp_path: Path, write: Write) -> None:
    path, complaint = write(tmp_path / "set", {"05_01.amc": b"text"}), r"set.* holds no 05\.asf, the skeleton of subj"
    with open_source(path) as opened, pytest.raises(InputError, match=complaint):
        find_subject(opened, 5, [1])


@both
def test_a_file_that_unpacks_without_end(tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "LARGEST", {".asf": 2**20, ".amc": 2 * 2**20})
    path = write(tmp_path / "bomb", {"35.asf": b"\0" * (2**20 + 1), "35_01.amc": b"\0" * 2 * 2**20})
    with open_source(path) as opened:
        assert len(opened.read("35_01.amc")) == 2 * 2**20
        with pytest.raises(InputError, match=r"35\.asf.* is larger than 1 MB"):
            opened.read("35.asf")


def test_a_zip_file_is_never_unpacked(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    names = ("../../35.asf", "/35_01.amc", "a\n35_02.amc/35_02.amc")
    path = write_zip(tmp_path / "in" / "slip", dict(zip(names, (b"bones", b"first", b"second"), strict=True)))
    with open_source(path) as opened:
        found = find_subject(opened, 35, [1, 2])
        assert opened.read(found.skeleton) == b"bones"
        assert [opened.read(found.trials[trial]) for trial in (1, 2)] == [b"first", b"second"]
    assert [p.name for p in tmp_path.rglob("*")] == ["in", "slip.zip"]


def test_damaged_zip_files(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "set", {"35.asf": os.urandom(5000), "35_01.amc": b"frames"})
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    with pytest.raises(InputError, match=r"set\.zip is neither a folder nor a readable zip file"), open_source(path):
        pass
    path.write_bytes(whole[:100] + bytes(50) + whole[150:])
    with open_source(path) as opened, pytest.raises(InputError, match=r"^35\.asf in .*set\.zip is damaged"):
        opened.read("35.asf")
    encrypted = bytearray(whole)
    encrypted[6] |= 1  # the flag in the member's own head ...
    encrypted[whole.rindex(b"PK\1\2", 0, whole.rindex(b"PK\1\2")) + 8] |= 1  # ... and in the directory
    path.write_bytes(encrypted)
    with open_source(path) as opened, pytest.raises(InputError, match=r"35\.asf in .*set\.zip is encrypted"):
        opened.read("35.asf")


def test_a_member_twice(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as archive:
        archive.writestr("35.asf", b"text")
        archive.writestr("35_01.amc", b"text")
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("35_01.amc", b"text")
    with open_source(tmp_path / "set.zip") as opened, pytest.raises(InputError, match=r"in 35_01\.amc, twice"):
        find_subject(opened, 35, [1])


def test_what_is_no_source(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("no zip")
    os.mkfifo(tmp_path / "pipe")
    for name, complaint in (("absent", "there is no"), ("text.zip", "is neither"), ("pipe", "is neither")):
        with pytest.raises(InputError, match=complaint), open_source(tmp_path / name):
            pass


def test_a_folder_with_odd_files(tmp_path: Path) -> None:
    write_folder(tmp_path, {"35.asf": b"bones"})
    os.mkfifo(tmp_path / "35_01.amc")
    (tmp_path / "35_02.amc").symlink_to(tmp_path / "nowhere")
    with open_source(tmp_path) as opened:
        found = find_subject(opened, 35, [1, 2])
        for trial in (1, 2):
            with pytest.raises(InputError, match=rf"35_0{trial}\.amc is not a file"):
                opened.read(found.trials[trial])
