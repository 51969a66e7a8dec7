"""Expert sets from others: damaged and crafted .npz files."""

import dataclasses
import gc
import io
import math
import os
import pickle
import re
import resource
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.data_sections import LettersSpec, YJunctionSpec
from ssmail.config.experiments import build_spec
from ssmail.data import expert_sets, letters, npz_file, yjunction
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import SPLITS, ExpertSet, Trajectories
from ssmail.errors import InputError
from ssmail.plots import skeleton
from ssmail.training.loop import TrainingLoop
from tests.data.mocap.handmade import write_set
from tests.hostile import harness
from tests.hostile.harness import LONGEST, cases, hold, mutated, time_limit, watching

JUNCTION = YJunctionSpec(train=2, validation=1, test=1, agents=2, steps=50, lane_angle=43.0, jitter=1.0, seed=0)
WORD = LettersSpec(word="IL", train=2, validation=1, test=1, steps=20, jitter=1.0, seed=0)
ENVIRONMENTS = ("yjunction", "letters", "mocap")
ONE = st.integers(0, 2**63 - 1)  # seeds

DTYPES = (
    "<f8",
    ">f8",
    "<f4",
    "|O",
    "<i8",
    "<U5",
    "<U2000000000",
    "|V8",
    "<M8[s]",
    "<M8[999999999999s]",
    "<c16",
    "f9",
    "",
)
DTYPES += (
    "'" * 9,
    "<f8', 'x': __import__('this'), 'y': '",
    "<f8\n",
    "U" * 900,
    "\x1b[31m",
    "(2,)f8",
    "f8,f8",
    "i" + "9" * 400,
)
SHAPES = (
    "()",
    "(2, 50, 2, 2)",
    "(2,)",
    "(-1,)",
    "(999999999999, 999999999999)",
    "(" + "9" * 700 + ",)",
    "(1, " * 300,
    "2",
)
SHAPES += (
    "(" * 200 + ")" * 200,
    "(0,)",
    "(True,)",
    "(1e3,)",
    "(2**62,)",
    "(1,)" * 50,
    "(1, 1, 1, 1, 1, 1, 1, 1)",
    "[2]",
    "\x00",
)
JSON = (
    "{",
    "[" * 100_000,
    '{"a":' * 50_000,
    "null",
    "[]",
    "0",
    '"yjunction"',
    "NaN",
    "9" * 5000,
    "{}",
    '{"environment": []}',
)
JSON += (
    '{"environment": "mocap"}',
    '{"environment": "' + "x" * 5000 + '"}',
    '{"environment": "\\u001b[31m\\u202e"}',
    "\ud800",
)
VALUES = (
    None,
    True,
    -1,
    0,
    10**18,
    10**400,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x" * 5000,
    "\x1b[31m",
    [],
    [[]],
    {},
    [1],
)


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> "Valid":
    """A small valid file of each environment."""
    folder = tmp_path_factory.mktemp("valid")
    expert_sets.save(yjunction.generate(JUNCTION), folder / "yjunction.npz")
    expert_sets.save(letters.generate(WORD), folder / "letters.npz")
    write_set(folder / "mocap.npz")
    skeleton.draw(skeleton.collect(folder / "mocap.npz"))  # matplotlib makes its folders and its list of fonts
    return Valid({name: (folder / f"{name}.npz").read_bytes() for name in ENVIRONMENTS})


class Valid(dict[str, bytes]):
    """The contents of valid files; not shown when a test fails."""

    def __repr__(self) -> str:
        return "valid"


def read_or_refused(path: Path) -> ExpertSet | None:
    """Load a file: it is either a set in which everything is as it should be, or refused in one sentence."""
    harness.counted += 1
    found = None
    with watching(path.parent) as watch, time_limit():
        try:
            found = expert_sets.load(path)
        except InputError as error:
            sentence = str(error).replace(str(path), "FILE")
            assert "FILE" in sentence
            assert len(sentence) <= LONGEST - 50, sentence
            assert sentence.isprintable(), sentence
    assert not watch.wrong, watch.wrong
    if found is not None:
        for split in (found.train, found.validation, found.test):
            assert np.isfinite(split.positions).all()
            assert split.positions.flags.writeable
            assert split.mode.max() < 2
    return found


def members(contents: bytes) -> dict[str, bytes]:
    """The members of a valid file."""
    with zipfile.ZipFile(io.BytesIO(contents)) as archive:
        return {member.filename: archive.read(member) for member in archive.infolist()}


def pack(path: Path, files: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> Path:
    """Write an archive; names may be there twice."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files:
            member = zipfile.ZipInfo(name)
            member.compress_type = compression
            with archive.open(member, "w") as file:
                file.write(data)
    return path


def array(data: Any, dtype: Any = None) -> bytes:
    """A .npy file; objects are pickled."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.array(data, dtype=dtype))
    return file.getvalue()


def header(dtype: str, shape: str, fortran: str = "False", magic: bytes = npz_file.MAGIC, length: int = -1) -> bytes:
    """The beginning of a .npy file, as numpy writes it but for what it says."""
    text = f"{{'descr': '{dtype}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()
    return magic + struct.pack("<H", (len(text) if length < 0 else length) % 2**16) + text


@given(environment=st.sampled_from(ENVIRONMENTS), seed=ONE, changes=st.sampled_from([1, 3, 20]))
@cases(quick=60, fuzz=1300)
def test_changed_bytes(tmp_path: Path, valid: Valid, environment: str, seed: int, changes: int) -> None:
    (tmp_path / "a.npz").write_bytes(mutated(valid[environment], seed, changes))
    read_or_refused(tmp_path / "a.npz")


def changed_member(name: str, data: bytes) -> st.SearchStrategy[tuple[str, bytes]]:
    """A member with another name, header, text or number, or with other data."""
    names = st.text(max_size=20) | st.sampled_from(["../../a.npy", "/etc/passwd", "hash"])
    headers = st.builds(
        header,
        st.sampled_from(DTYPES),
        st.sampled_from(SHAPES),
        st.sampled_from(["False", "True", "None", "1", "__import__('this')"]),
        st.sampled_from([npz_file.MAGIC, b"\x93NUMPY\x02\x00", b"\x93NUMPY\x03\x00", b"PK\3\4"]),
        st.sampled_from([-1, -1, 0, 10, 65535]),
    )
    contents = st.one_of(
        headers.map(lambda start: start + data[128:]),
        (st.sampled_from(JSON) | st.text(max_size=30)).map(array),
        (st.floats() | st.integers(-(2**63), 2**63 - 1)).map(lambda value: array([value])),
        ONE.map(lambda seed: mutated(data, seed)),
        st.sampled_from([b"", data[:60], data + bytes(1000), pickle.dumps([1])]),
    )
    return st.tuples(names, st.just(data)) | st.tuples(st.just(name), contents)


@st.composite
def changed(draw: st.DrawFn, files: dict[str, bytes]) -> tuple[list[tuple[str, bytes]], int]:
    """Up to three members of a valid file changed, dropped or doubled, and the compression of all of them."""
    out = list(files.items())
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(out) - 1))
        out[at] = draw(changed_member(*out[at]))
        what = draw(st.integers(0, 9))
        if what == 0:
            out.insert(draw(st.integers(0, len(out))), draw(st.sampled_from(out)))
        elif what == 1 and len(out) > 1:
            del out[at]
    unusual = [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    return out, draw(st.sampled_from([zipfile.ZIP_STORED] * 6 + unusual))


@given(data=st.data(), environment=st.sampled_from(ENVIRONMENTS))
@cases(quick=60, fuzz=1200)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_changed_members(tmp_path: Path, valid: Valid, data: st.DataObject, environment: str) -> None:
    files, compression = data.draw(changed(members(valid[environment])))
    try:
        pack(tmp_path / "a.npz", files, compression)
    except UnicodeEncodeError:  # no zip file can have such a name
        return
    read_or_refused(tmp_path / "a.npz")


def with_number(array: Any, at: int, value: float) -> Any:
    """A copy of an array with one element replaced."""
    out = np.array(array)
    if out.size and (np.issubdtype(out.dtype, np.floating) or (np.isfinite(value) and abs(value) < 2**62)):
        out.flat[at % out.size] = value
    return out


@st.composite
def forged(draw: st.DrawFn, experts: ExpertSet) -> ExpertSet:
    """A set with other values in it, and with the hash that belongs to them."""
    number = st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e9, 1e-320, -1, 0, 1, 2, 2.0**40, 9])
    splits = {split: getattr(experts, split) for split in SPLITS}
    parameters, joints, parents = dict(experts.parameters), list(experts.joints), list(experts.parents)
    lines, sources = experts.centre_lines, dict(experts.sources)
    for _ in range(draw(st.integers(1, 3))):
        what = draw(st.sampled_from(["number", "number", "lines", "parameter", "joint", "parent", "sources"]))
        if what == "number":
            split = draw(st.sampled_from(SPLITS))
            field = draw(st.sampled_from(dataclasses.fields(Trajectories))).name
            if (old := getattr(splits[split], field)) is not None:
                new = with_number(old, draw(st.integers(0, 10**6)), draw(number))
                splits[split] = dataclasses.replace(splits[split], **{field: new})
        elif what == "lines":
            lines = with_number(lines, draw(st.integers(0, 10**6)), draw(number))
        elif what == "parameter":
            parameters[draw(st.sampled_from([*parameters, "x"]))] = draw(st.sampled_from(VALUES))
        elif what == "joint" and joints:
            joints[draw(st.integers(0, len(joints) - 1))] = draw(
                st.sampled_from(["", "root", "\x1b[31m", "x" * 5000, "é"])
            )
        elif what == "parent" and parents:
            parents[draw(st.integers(0, len(parents) - 1))] = draw(
                st.sampled_from([-1, 0, 1, 2, 99, -(2**63), 2**63 - 1])
            )
        elif what == "sources":
            sources[draw(st.sampled_from(["a", "\x1b", "x" * 5000]))] = draw(st.sampled_from(VALUES))  # type: ignore[assignment]
    parameters["environment"] = experts.environment
    return ExpertSet.bundle(splits, lines, parameters, tuple(joints), tuple(parents), sources)


@given(data=st.data(), environment=st.sampled_from(ENVIRONMENTS))
@cases(quick=40, fuzz=500)
def test_forged_sets(tmp_path: Path, valid: Valid, data: st.DataObject, environment: str) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(valid[environment])
    try:
        expert_sets.save(data.draw(forged(expert_sets.load(path))), path, force=True)
    except ValueError:  # a scaling that there is not
        return
    found = read_or_refused(path)
    if found is not None:
        assert found.is_scalable


def damaged(data: st.DataObject, path: Path, whole: bytes) -> bool:
    """Write a file that is damaged in one of the three ways; False if there cannot be such a file."""
    path.write_bytes(whole)
    try:
        kind = data.draw(st.integers(0, 2))
        if kind == 0:
            path.write_bytes(mutated(whole, data.draw(ONE)))
        elif kind == 1:
            pack(path, *data.draw(changed(members(whole))))
        else:
            expert_sets.save(data.draw(forged(expert_sets.load(path))), path, force=True)
    except ValueError:
        return False
    return True


@given(data=st.data())
@cases(quick=6, fuzz=100)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_the_command_that_draws_a_set(tmp_path: Path, valid: Valid, data: st.DataObject) -> None:
    if damaged(data, tmp_path / "a.npz", valid["mocap"]):
        hold(tmp_path, "plot", "--out", tmp_path / "figures", "skeleton", "--data", tmp_path / "a.npz")


@given(data=st.data(), environment=st.sampled_from(["yjunction", "letters"]))
@cases(quick=6, fuzz=100)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_what_is_read_can_be_trained_on(tmp_path: Path, valid: Valid, data: st.DataObject, environment: str) -> None:
    path = tmp_path / "a.npz"
    if not damaged(data, path, valid[environment]) or read_or_refused(path) is None:
        return
    with time_limit():
        loop = TrainingLoop(build_spec("constant-velocity", environment, "smoke", [f"data.path={path}"]), seed=0)
        values, _ = loop.final_evaluation()
    assert all(map(math.isfinite, values.values())), values


class Crafted(NamedTuple):
    """A file that is refused, and what the sentence says of it."""

    files: list[tuple[str, bytes]]
    sentence: str
    compression: int = zipfile.ZIP_STORED


def crafted(files: dict[str, bytes]) -> dict[str, Crafted]:
    """Attacks on a yjunction set."""
    place = "train/positions.npy"

    def other(name: str, data: bytes) -> list[tuple[str, bytes]]:
        return list((files | {name: data}).items())

    bomb = header("<f8", "(2, 50, 2, 999999999)")
    deep = array("[" * 100_000)
    return {
        "pickled": Crafted(other(place, array([Trap()], object)), "no array of numbers"),
        "enormous shape": Crafted(other(place, bomb + bytes(100)), "not as large as its shape says"),
        "code as header": Crafted(
            other(place, header("<f8", "__import__('this')") + bytes(100)), "no array of numbers"
        ),
        "nested header": Crafted(other(place, header("<f8", "(" * 500) + bytes(100)), "no array of numbers"),
        "endless number": Crafted(other(place, header("<f8", "(" + "9" * 800 + ",)")), "no array of numbers"),
        "big-endian": Crafted(other(place, array(np.zeros((2, 50, 2, 2)), ">f8")), "no array of numbers"),
        "dates": Crafted(other(place, array(np.zeros((2, 50, 2, 2)), "M8[s]")), "no array of numbers"),
        "other shape": Crafted(other(place, array(np.zeros((2, 50, 2, 3)))), r"has shape \(2, 50, 2, 3\) instead of"),
        "no lane": Crafted(
            other("train/mode.npy", array([7, 0])), "train/mode in .* holds a number that it cannot hold"
        ),
        "lines": Crafted(other("centre_lines.npy", array(["a", "b"])), "centre_lines in .* has shape"),
        "nested JSON": Crafted(other("parameters.npy", deep), "parameters inside .* cannot be read"),
        "endless JSON": Crafted(other("parameters.npy", array("[" * 2**21)), "longer than in any"),
        "no text": Crafted(other("parameters.npy", array([1.0])), "parameters in .* has shape"),
        "invalid text": Crafted(other("parameters.npy", header("<U1", "()") + b"\xff" * 4), "cannot be read"),
        "list": Crafted(other("parameters.npy", array('{"environment": [1]}')), "which this ssmail does not know"),
        "twice": Crafted([*files.items(), (place, files[place])], "holds the array 'train/positions' twice"),
        "twice, with and without ending": Crafted([*files.items(), ("hash", files["hash.npy"])], "'hash' twice"),
        "more": Crafted([*files.items(), ("../../a.npy", array(1))], r"holds '\.\./\.\./a', which is no array of such"),
        "too many": Crafted([*files.items(), *((f"{n}.npy", array(1)) for n in range(64))], "is larger than any"),
        **{
            f"compressed {kind}": Crafted(list(files.items()), "is compressed or encrypted", kind)
            for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
        },
    }


class Trap:
    """Imports a module when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return __import__, ("this",)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_crafted_files(tmp_path: Path, valid: Valid) -> None:
    path = tmp_path / "a.npz"
    for name, attack in crafted(members(valid["yjunction"])).items():
        pack(path, attack.files, attack.compression)
        with watching(tmp_path) as watch, time_limit(5), pytest.raises(InputError) as caught:
            expert_sets.load(path)
        assert watch.wrong == [], name
        assert re.search(attack.sentence, str(caught.value)), (name, str(caught.value))
        assert str(path) in str(caught.value)
        assert "make it again with `ssmail generate-yjunction --force`" in str(caught.value)


def test_members_that_lie_on_one_another(tmp_path: Path, valid: Valid) -> None:
    """Many entries of the list for the same bytes: a bomb without compression."""
    path = tmp_path / "a.npz"
    whole = bytearray(valid["yjunction"])
    directory = whole.index(b"PK\1\2")
    first = bytes(whole[directory : whole.index(b"PK\1\2", directory + 1)])
    names = (f"{number:015d}.npy".encode() for number in range(40))
    entries = b"".join(first[:46] + name for name in names)
    assert len(first) == 46 + 19
    end = whole[whole.index(b"PK\5\6") :]
    struct.pack_into("<HHL", end, 8, 40, 40, len(entries))
    path.write_bytes(bytes(whole[:directory]) + entries + bytes(end))
    with pytest.raises(InputError, match=r"a\.npz declares more than it holds"):
        expert_sets.load(path)


def test_a_file_larger_than_any_set(tmp_path: Path, valid: Valid, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.npz").write_bytes(valid["yjunction"])
    monkeypatch.setattr(npz_file, "LARGEST_FILE", len(valid["yjunction"]) - 1)
    with pytest.raises(InputError, match="is larger than any expert set"):
        expert_sets.load(tmp_path / "a.npz")


def test_headers_do_not_make_memory(tmp_path: Path, valid: Valid) -> None:
    """A sparse file of terabytes, and a header that declares as much: refused before anything is read."""
    path = tmp_path / "a.npz"
    path.write_bytes(valid["yjunction"])
    os.truncate(path, 2**40)
    tracemalloc.start()
    with time_limit(5), pytest.raises(InputError, match=r"is truncated or not an .npz file"):
        expert_sets.load(path)
    files = members(valid["yjunction"])
    pack(path, [*(files | {"train/positions.npy": header("<f8", "(999999999999,)") + bytes(800)}).items()])
    with pytest.raises(InputError, match="not as large as its shape says"):
        expert_sets.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**25


FORGED: dict[str, tuple[Callable[[ExpertSet], dict[str, Any]], str]] = {
    "circle": (lambda experts: {"parents": (-1, 2, 1, 2, 0)}, "do not all hang on the first one"),
    "two roots": (lambda experts: {"parents": (-1, -1, 0, 2, 0)}, "do not all hang on the first one"),
    "no root": (lambda experts: {"parents": (0, 0, 0, 2, 0)}, "do not all hang on the first one"),
    "outside": (lambda experts: {"parents": (-1, 0, 0, 2, 99)}, "do not all hang on the first one"),
    "escapes": (lambda experts: {"joints": ("root", "\x1b[31m", "a", "b", "c")}, "have no proper names"),
    "right to left": (lambda experts: {"joints": ("root", "\u202e", "a", "b", "c")}, "have no proper names"),
    "long name": (lambda experts: {"joints": ("root", "x" * 101, "a", "b", "c")}, "have no proper names"),
    "two of a name": (lambda experts: {"joints": ("root", "a", "a", "b", "c")}, "have no proper names"),
    "other sources": (lambda experts: {"sources": {"35.asf": "\x1b[31m"}}, "the sources inside .* are not the digests"),
    "enormous": (lambda experts: {"test": times(experts.test, 1e200)}, "too large or too small to be scaled"),
    "still": (lambda experts: {"train": times(experts.train, 0)}, "too large or too small to be scaled"),
    "trial": (
        lambda experts: {"test": dataclasses.replace(experts.test, trial=experts.test.trial + 2**62)},
        "test/trial in .* holds a number that it cannot hold",
    ),
    "frame": (
        lambda experts: {"test": dataclasses.replace(experts.test, frame=experts.test.frame - 10**9)},
        "test/frame in .* holds a number that it cannot hold",
    ),
}


def times(trajectories: Trajectories, factor: float) -> Trajectories:
    positions, velocities = trajectories.positions * factor, trajectories.velocities * factor
    return dataclasses.replace(trajectories, positions=positions, velocities=velocities, continuations=positions[None])


@pytest.mark.parametrize(("change", "sentence"), FORGED.values(), ids=FORGED)
def test_forged_recordings(
    tmp_path: Path,
    valid: Valid,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[ExpertSet], dict[str, Any]],
    sentence: str,
) -> None:
    """Sets whose hash is right."""
    path = tmp_path / "a.npz"
    path.write_bytes(valid["mocap"])
    experts = expert_sets.load(path)
    experts = dataclasses.replace(experts, **change(experts))
    splits = {split: getattr(experts, split) for split in SPLITS}
    whole = (experts.centre_lines, experts.parameters, experts.joints, experts.parents, experts.sources)
    with monkeypatch.context() as patch:
        patch.setattr(Scaling, "fit", lambda *_: Scaling(0.0, 1.0, 0.0, 1.0))
        expert_sets.save(ExpertSet.bundle(splits, *whole), path, force=True)
    with pytest.raises(InputError, match=sentence):
        expert_sets.load(path)


def test_files_that_are_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "device.npz").symlink_to("/dev/zero")
    (tmp_path / "circle.npz").symlink_to("circle.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    for name in ("pipe", "folder", "device", "circle", "empty"):
        with time_limit(5), pytest.raises(InputError, match=rf"{name}\.npz is truncated or not an \.npz file"):
            expert_sets.load(tmp_path / f"{name}.npz")
    with pytest.raises(InputError, match="there is no file"):
        expert_sets.load(tmp_path / "a\0b.npz")


def test_a_link_to_a_set_is_followed(tmp_path: Path, valid: Valid) -> None:
    (tmp_path / "a.npz").write_bytes(valid["letters"])
    (tmp_path / "b.npz").symlink_to("a.npz")
    assert expert_sets.load(tmp_path / "b.npz").environment == "letters"


@pytest.mark.parametrize("size", [0, 100, 5000])
def test_a_file_that_shrinks_while_it_is_read(
    tmp_path: Path, valid: Valid, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(valid["yjunction"])
    complete = npz_file.NpzFile.require_exactly

    def shrink(file: npz_file.NpzFile, *keys: str) -> None:
        complete(file, *keys)
        os.truncate(path, size)

    monkeypatch.setattr(npz_file.NpzFile, "require_exactly", shrink)
    with pytest.raises(InputError, match=r"is truncated or not an .npz file"):
        expert_sets.load(path)


def test_sets_are_written_to_regular_files_only(tmp_path: Path) -> None:
    """`--out /dev/null --force` must not put a file in the place of the device."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to(os.devnull)
    for path in (tmp_path / "pipe", tmp_path / "null", tmp_path):
        with pytest.raises(InputError, match="is a folder, pipe or device; choose another --out"):
            expert_sets.save(letters.generate(WORD), path, force=True)
    with pytest.raises(InputError, match=r"cannot write .*: File name too long; choose"):
        expert_sets.save(letters.generate(WORD), tmp_path / ("x" * 300))


def test_a_full_disk(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A file may have 1000 bytes: one sentence, nothing left over."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(InputError, match=r"cannot write .*: File too large; choose a writable --out"):
            expert_sets.save(letters.generate(WORD), tmp_path / "a.npz")
        gc.collect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
