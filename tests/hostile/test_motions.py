"""Recorded motion from others: skeletons, motions, and zip files with them."""

import io
import os
import re
import struct
import subprocess
import tracemalloc
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.data.mocap import amc as amc_module
from ssmail.data.mocap.source import find_subject, open_source
from ssmail.errors import InputError
from tests.data.mocap.handmade import PERSON, B, asf, walk
from tests.data.mocap.test_hostile import damaged
from tests.hostile.harness import cases, hold, mutated, refused, time_limit

ONE = st.integers(0, 2**63 - 1)  # seeds
SKELETON = asf(*PERSON)
FILES = {"35.asf": SKELETON, "a/35_01.amc": walk(51, 1), "35_02.amc": walk(52, 2), "35_03.amc": walk(101, 3)}
TRIALS = ("--train", "1", "--val", "2", "--test", "3")
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
NAMES = (
    "../../35.asf",
    "/35_01.amc",
    "35_01.amc/",
    "35.asf\0x",
    "\x1b[31m/35.asf",
    "\u202e/35_01.amc",
    "C:\\35_02.amc",
    "con/35.asf",
)
NAMES += (
    "x" * 60_000 + "/35_01.amc",
    "35_01.AMC",
    "035.asf",
    "35_1.amc",
    "./35.asf",
    "a/../35.asf",
    "",
    ".",
    "é/35.asf",
    "~/35.asf",
)
LINK = 0o120777 << 16  # external attributes of a member that is a symbolic link


def packed(files: Sequence[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED, attributes: int = 0) -> bytes:
    contents = io.BytesIO()
    with zipfile.ZipFile(contents, "w") as archive:
        for name, data in files:
            member = zipfile.ZipInfo(name)
            member.compress_type, member.external_attr = method, attributes
            archive.writestr(member, data)
    return contents.getvalue()


VALID = {method: packed([*FILES.items()], method) for method in METHODS}


def write_folder(folder: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def prepare(folder: Path, source: Path) -> None:
    """Run prep-mocap on a source below `folder`: it writes the set or refuses, and writes nothing else."""
    before = {path for path in folder.rglob("*") if path.name != "out.npz"}
    hold(folder, "prep-mocap", "--source", source, "--out", folder / "out.npz", "--force", *TRIALS)
    assert {path for path in folder.rglob("*") if path.name != "out.npz"} == before


@given(name=st.sampled_from([*FILES]), seed=ONE, changes=st.sampled_from([1, 3, 20]))
@cases(quick=25, fuzz=700)
def test_changed_bytes(tmp_path: Path, name: str, seed: int, changes: int) -> None:
    write_folder(tmp_path / "in", FILES | {name: mutated(FILES[name], seed, changes)})
    prepare(tmp_path, tmp_path / "in")


@given(data=st.data(), name=st.sampled_from([*FILES]))
@cases(quick=20, fuzz=500)
def test_changed_words(tmp_path: Path, data: st.DataObject, name: str) -> None:
    write_folder(tmp_path / "in", FILES | {name: data.draw(damaged(FILES[name]))})
    prepare(tmp_path, tmp_path / "in")


@given(method=st.sampled_from([*METHODS, zipfile.ZIP_DEFLATED]), seed=ONE, changes=st.sampled_from([1, 3, 20]))
@cases(quick=25, fuzz=600)
def test_changed_archives(tmp_path: Path, method: int, seed: int, changes: int) -> None:
    (tmp_path / "in.zip").write_bytes(mutated(VALID[method], seed, changes))
    prepare(tmp_path, tmp_path / "in.zip")


FIELDS = {"version": (6, "H"), "flags": (8, "H"), "method": (10, "H"), "time": (12, "L"), "sum": (16, "L")}
FIELDS |= {"packed": (20, "L"), "unpacked": (24, "L"), "name": (28, "H"), "extra": (30, "H"), "comment": (32, "H")}
FIELDS |= {"disk": (34, "H"), "attributes": (38, "L"), "offset": (42, "L")}  # of an entry of the list of members
NUMBERS = (0, 1, 2, 8, 9, 12, 14, 32, 64, 99, 1000, 2**15, 2**16 - 1, 2**31, 2**32 - 1)


@given(data=st.data())
@cases(quick=20, fuzz=500)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_changed_lists_of_members(tmp_path: Path, data: st.DataObject) -> None:
    """Other names, links, and numbers that zipfile would believe."""
    files = [*FILES.items()]
    for _ in range(data.draw(st.integers(0, 2))):
        at = data.draw(st.integers(0, len(files) - 1))
        name = data.draw(st.sampled_from(NAMES) | st.text(max_size=10))
        try:
            name.encode()
        except UnicodeEncodeError:
            return
        files.insert(at, (name, files[at][1]))
    contents = bytearray(packed(files, data.draw(st.sampled_from(METHODS)), data.draw(st.sampled_from([0, LINK]))))
    entries = [found.start() for found in re.finditer(b"PK\1\2", bytes(contents))]
    for _ in range(data.draw(st.integers(0, 3))):
        offset, kind = FIELDS[data.draw(st.sampled_from([*FIELDS]))]
        value = data.draw(st.sampled_from(NUMBERS)) % 2 ** (8 * struct.calcsize(kind))
        struct.pack_into(f"<{kind}", contents, data.draw(st.sampled_from(entries)) + offset, value)
    if data.draw(st.booleans()):
        offset, kind = data.draw(st.sampled_from([(8, "H"), (10, "H"), (12, "L"), (16, "L"), (20, "H")]))
        value = data.draw(st.sampled_from(NUMBERS)) % 2 ** (8 * struct.calcsize(kind))
        struct.pack_into(f"<{kind}", contents, contents.rindex(b"PK\5\6") + offset, value)
    (tmp_path / "in.zip").write_bytes(contents)
    prepare(tmp_path, tmp_path / "in.zip")


def refused_archive(folder: Path, contents: bytes) -> str:
    (folder / "in.zip").write_bytes(contents)
    return refused(folder, "prep-mocap", "--source", folder / "in.zip", "--out", folder / "out.npz", *TRIALS)


@pytest.mark.parametrize("method", METHODS[2:])
def test_members_packed_in_an_unusual_way(tmp_path: Path, method: int) -> None:
    """Damaged, they end in exceptions of their own; whole, LZMA may ask for 4 GB."""
    damaged = bytearray(VALID[method])
    damaged[40:80] = bytes(40)
    for contents in (VALID[method], bytes(damaged)):
        sentence = refused_archive(tmp_path, contents)
        assert re.fullmatch(r"35\.asf in .*in\.zip is encrypted or packed in an unusual way; pack it plainly", sentence)


@pytest.mark.parametrize("flag", [0x1, 0x20, 0x40])
def test_encrypted_members(tmp_path: Path, flag: int) -> None:
    contents = bytearray(VALID[zipfile.ZIP_DEFLATED])
    contents[contents.index(b"PK\1\2") + 8] |= flag
    assert "is encrypted or packed in an unusual way; pack it plainly" in refused_archive(tmp_path, bytes(contents))


@pytest.mark.parametrize("at", [60, 100, 200])
def test_damaged_members(tmp_path: Path, at: int) -> None:
    contents = bytearray(VALID[zipfile.ZIP_DEFLATED])
    contents[at : at + 20] = bytes(20)
    assert "is damaged; get the zip file again" in refused_archive(tmp_path, bytes(contents))


def test_a_bomb(tmp_path: Path) -> None:
    """32 GB of zeros in 32 MB would be too slow to make; a gigabyte shows it."""
    with zipfile.ZipFile(tmp_path / "in.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("35.asf", SKELETON)
        for trial in (1, 2, 3):
            with archive.open(f"35_{trial:02d}.amc", "w", force_zip64=True) as file:
                for _ in range(64):
                    file.write(bytes(2**20))
    tracemalloc.start()
    with time_limit(20), open_source(tmp_path / "in.zip") as source:
        subject = find_subject(source, 35, [1, 2, 3])
        with pytest.raises(InputError, match=r"35_01\.amc in .* is larger than 32 MB"):
            source.read(subject.trials[1])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3 * 32 * 2**20


def test_members_cannot_leave_the_archive(tmp_path: Path) -> None:
    """Names that lead outside, and links: read as text, and nothing is written but the set."""
    (tmp_path / "in").mkdir()
    names = ("../../35.asf", "/35_01.amc", "..\\..\\35_02.amc", "a/../../../35_03.amc")
    files = list(zip(names, FILES.values(), strict=True))
    (tmp_path / "in" / "a.zip").write_bytes(packed(files))
    source = tmp_path / "in" / "a.zip"
    sentence = refused(tmp_path, "prep-mocap", "--source", source, "--out", tmp_path / "a.npz", *TRIALS)
    assert "lacks 35_02.amc" in sentence  # a backslash is part of the name
    files[2] = ("../35_02.amc", FILES["35_02.amc"])
    source.write_bytes(packed(files))
    code, _, _ = hold(tmp_path, "prep-mocap", "--source", source, "--out", tmp_path / "a.npz", *TRIALS)
    assert code == 0
    assert {path.name for path in tmp_path.rglob("*")} == {"in", "a.zip", "a.npz"}
    (tmp_path / "secret").write_bytes(b"root:secret:0\n")
    links = packed([(name, b"../secret") for name in FILES], attributes=LINK)
    assert "secret" not in refused_archive(tmp_path, links).replace("../secret", "")


def test_a_member_that_only_the_list_calls_small(tmp_path: Path) -> None:
    contents = bytearray(VALID[zipfile.ZIP_DEFLATED])
    struct.pack_into("<L", contents, contents.index(b"PK\1\2") + 24, 10)
    assert "35.asf in" in refused_archive(tmp_path, bytes(contents))


def test_few_lines_that_ask_for_much_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand joints that never move, and as many frames as fit: the file is small, its positions are not."""
    monkeypatch.setattr(amc_module, "MOST_PLACES", 100_000)
    still = [B(f"b{number}", dof="") for number in range(999)]
    frames = b"".join(b"%d\nroot 0 0 0 0 0 0\n" % frame for frame in range(1, 200))
    files = FILES | {"35.asf": asf(*still), "a/35_01.amc": b":FULLY-SPECIFIED\n" + frames}
    write_folder(tmp_path / "in", files)
    sentence = refused(tmp_path, "prep-mocap", "--source", tmp_path / "in", "--out", tmp_path / "a.npz", *TRIALS)
    assert re.search(r"35_01\.amc, line 202: there are more frames than 1000 joints may have; get", sentence)
    # the joints that a frame may leave out are filled in
    moving = [B(f"b{number}", dof="rx ry rz") for number in range(999)]
    write_folder(tmp_path / "in", files | {"35.asf": asf(*moving), "a/35_01.amc": b":DEGREES\n" + frames})
    sentence = refused(tmp_path, "prep-mocap", "--source", tmp_path / "in", "--out", tmp_path / "a.npz", *TRIALS)
    assert "there are more frames than 1000 joints may have" in sentence


@pytest.mark.parametrize(
    ("name", "sentence"),
    [("x" * 101, "is longer than 100 characters, or not printable"), ("\x9b31m", "is longer than 100 characters, or")],
)
def test_names_of_joints(tmp_path: Path, name: str, sentence: str) -> None:
    skeleton = SKELETON.replace(b"lleg", name.encode("latin-1"))
    write_folder(tmp_path / "in", FILES | {"35.asf": skeleton})
    found = refused(tmp_path, "prep-mocap", "--source", tmp_path / "in", "--out", tmp_path / "a.npz", *TRIALS)
    assert sentence in found


def test_folders_with_special_files(tmp_path: Path) -> None:
    write_folder(tmp_path / "in", FILES)
    (tmp_path / "in" / "35_02.amc").unlink()
    os.mkfifo(tmp_path / "in" / "35_02.amc")
    arguments = ("prep-mocap", "--source", tmp_path / "in", "--out", tmp_path / "a.npz", *TRIALS)
    assert "35_02.amc is not a file; put the file there" in refused(tmp_path, *arguments)
    (tmp_path / "in" / "35_02.amc").unlink()
    (tmp_path / "in" / "35_02.amc").symlink_to("/dev/zero")
    assert "35_02.amc is not a file; put the file there" in refused(tmp_path, *arguments)
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "35_02.amc").unlink()
    (tmp_path / "in" / "35_02.amc").write_bytes(FILES["35_02.amc"])
    assert hold(tmp_path, *arguments)[0] == 0


def test_folders_in_folders(tmp_path: Path) -> None:
    """Deeper than Python may call itself, and with names longer than a message."""
    write_folder(tmp_path / "in", FILES)
    here = os.open(tmp_path / "in", os.O_RDONLY)
    for _ in range(1100):
        os.mkdir("b", dir_fd=here)
        below = os.open("b", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)
    try:
        code, _, err = hold(tmp_path, "prep-mocap", "--source", tmp_path / "in", "--out", tmp_path / "a.npz", *TRIALS)
        assert code == 0 or "nested too deeply" in err
    finally:
        subprocess.run(["rm", "-r", tmp_path / "in" / "b"], check=True)  # shutil.rmtree calls itself too
