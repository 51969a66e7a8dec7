"""`ssmail explain` on figures from strangers: mutated files, crafted records, bombs, pipes and cut files."""

import json
import os
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ssmail.config.experiments import build_spec
from ssmail.paper.results import FIGURES
from ssmail.plots import provenance, training_curves
from ssmail.plots.saving import save_figure, save_film
from ssmail.store import RunState, Store
from tests.hostile.harness import cases, hold, mutated, refused
from tests.paper.figure_files import save

FORMATS = ("png", "pdf", "svg")


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a database, a figure of it in every format, curves of training, and a film."""
    folder = tmp_path_factory.mktemp("gallery")
    store = Store.open(folder / "ssmail.db")
    for seed, state in ((0, RunState.FINISHED), (1, RunState.DIVERGED)):
        writer = store.start_run(
            build_spec("ssail", "yjunction", "smoke"), seed, dataset_hash="d" * 64, device="cpu", repeat=True
        )
        for epoch in (1, 2):
            writer.epoch(epoch, {"train/mode_mse": 0.1 / epoch, "validation/mode_mse": 0.2 / epoch})
        writer.finish(state)
    figure = FIGURES["fig4"]
    record = figure.collect(store)
    save("fig4", record, figure.draw(record), folder, FORMATS)
    curves = training_curves.collect(store, store.runs(), ["train/mode_mse"])
    save_figure("training", curves, training_curves.draw(curves), folder, ["png"])
    pictures = [Image.new("P", (4, 4), color) for color in (0, 1)]
    save_film(
        pictures, folder / "film.gif", [100, 100], replace(record, provenance=replace(record.provenance, figure="film"))
    )
    store.close()
    return folder


NAMES = (*(f"fig4_stability.{ending}" for ending in FORMATS), "training.png", "film.gif")


def explain(gallery: Path, folder: Path, figure: Path) -> tuple[int, str, str]:
    shutil.copyfile(gallery / "ssmail.db", folder / "ssmail.db")
    return hold(folder, "explain", figure, "--db", folder / "ssmail.db")


@cases(quick=40, fuzz=1000)
@given(name=st.sampled_from(NAMES), seed=st.integers(0, 2**32))
def test_mutated_files(gallery: Path, tmp_path: Path, name: str, seed: int) -> None:
    (tmp_path / name).write_bytes(mutated((gallery / name).read_bytes(), seed))
    explain(gallery, tmp_path, tmp_path / name)


HOSTILE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(10**30, 10**40),
    st.floats(),
    st.text(),
    st.sampled_from(
        [
            "../../x",
            "/etc/passwd",
            "\x1b[31m",
            "$\\frac{",
            "fig1",
            "fig8",
            "film",
            "forecast",
            "trajectories",
            "train/mode_mse",
            "*",
            "%",
        ]
    ),
    st.lists(st.text(max_size=5), max_size=3),
    st.dictionaries(
        st.sampled_from(["store", "runs", "statistic", "metrics", "group_by", "windows", "error", "x"]),
        st.text(),
        max_size=3,
    ),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to every part of a nested value."""
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in below for place in places(item, (*path, key)))]


def put(value: Any, place: tuple[Any, ...], new: Any) -> Any:
    if not place:
        return new
    key, *rest = place
    value[key] = put(value[key], tuple(rest), new)
    return value


def written(path: Path, text: str) -> Path:
    """A figure of the format that `path` ends in, with this text where ssmail keeps its record."""
    if path.suffix == ".png":
        info = PngInfo()
        info.add_itxt("ssmail", text)
        Image.new("L", (1, 1)).save(path, pnginfo=info)
    elif path.suffix == ".svg":
        dc = 'xmlns:dc="http://purl.org/dc/elements/1.1/"'
        clean = "".join(character if character.isprintable() else "?" for character in text)
        path.write_text(f"<svg {dc}><dc:description>{escape(clean)}</dc:description></svg>", "utf-8", "replace")
    else:
        safe = text.encode("ascii", "replace").replace(b"\\", rb"\\").replace(b"(", rb"\(").replace(b")", rb"\)")
        path.write_bytes(b"%PDF-1.4\n<< /Keywords (" + safe + b") >>\n%%EOF\n")
    return path


@cases(quick=40, fuzz=1000)
@given(data=st.data(), ending=st.sampled_from(FORMATS), name=st.sampled_from(["fig4_stability.png", "training.png"]))
def test_crafted_records(gallery: Path, tmp_path: Path, data: st.DataObject, ending: str, name: str) -> None:
    record = json.loads(provenance.read(gallery / name).as_json())
    for _ in range(data.draw(st.integers(1, 3))):
        record = put(record, data.draw(st.sampled_from(places(record))), data.draw(HOSTILE))
    figure = written(tmp_path / f"crafted.{ending}", json.dumps(record))
    shutil.copyfile(gallery / Path(name).with_suffix(".csv"), figure.with_suffix(".csv"))
    explain(gallery, tmp_path, figure)


def test_the_crafted_forms_are_read_when_the_record_is_good(gallery: Path, tmp_path: Path) -> None:
    good = provenance.read(gallery / "fig4_stability.png")
    for ending in FORMATS:
        assert provenance.read(written(tmp_path / f"good.{ending}", good.as_json())) == good


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{}",
        "1e999",
        "9" * 5000,
        "[" * 100_000,
        '{"figure":' * 5000,
        '"\\ud800"',
        "NaN",
        '{"figure":1}',
    ],
)
@pytest.mark.parametrize("ending", FORMATS)
def test_records_that_are_none(tmp_path: Path, ending: str, text: str) -> None:
    assert "carries no run ids" in refused(tmp_path, "explain", written(tmp_path / f"figure.{ending}", text))


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_that_is_cut_is_never_in_agreement(gallery: Path, tmp_path: Path, name: str) -> None:
    whole = (gallery / name).read_bytes()
    for share in (0, 0.1, 0.5, 0.9, 0.999):
        (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
        assert "is not a whole" in refused(tmp_path, "explain", tmp_path / name)


def test_a_png_with_an_altered_byte_is_damaged(gallery: Path, tmp_path: Path) -> None:
    contents = bytearray((gallery / "fig4_stability.png").read_bytes())
    contents[len(contents) // 2] ^= 1
    (tmp_path / "altered.png").write_bytes(contents)
    assert "is not a whole PNG" in refused(tmp_path, "explain", tmp_path / "altered.png")


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(*chunks: bytes, width: int = 1, height: int = 1) -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + chunk(b"IDAT", zlib.compress(b"\0\0")) + chunk(b"IEND", b"")
    )


BOMBS = {
    "text.png": png(chunk(b"zTXt", b"ssmail\0\0" + zlib.compress(bytes(2**28), 9))),
    "texts.png": png(*[chunk(b"zTXt", b"a%d\0\0" % n + zlib.compress(bytes(2**20 - 9), 9)) for n in range(200)]),
    "profile.png": png(chunk(b"iCCP", b"a\0\0" + zlib.compress(bytes(2**28), 9))),
    "huge.png": png(width=2**31 - 1, height=2**31 - 1),
    "entities.svg": b'<!DOCTYPE svg [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY a%d "%s">' % (n, b"&a%s;" % (b"%d" % (n - 1) if n > 1 else b"") * 10) for n in range(1, 10))
    + b"]><svg>&a9;</svg>",
    "external.svg": b'<!DOCTYPE svg [<!ENTITY a SYSTEM "file:///etc/passwd">]><svg>&a;</svg>',
    "utf16.svg": '<?xml version="1.0" encoding="utf-16"?><!DOCTYPE s [<!ENTITY a "b">]><s>&a;</s>'.encode("utf-16"),
    "deep.svg": b"<a>" * 300_000,
    "huge.gif": b"GIF89a" + struct.pack("<HHBBB", 65535, 65535, 0, 0, 0) + b";",
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_before_they_unpack(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(BOMBS[name])
    refused(tmp_path, "explain", tmp_path / name)


@pytest.mark.parametrize("ending", [*FORMATS, "gif", "csv"])
def test_a_pipe_is_not_waited_for(gallery: Path, tmp_path: Path, ending: str) -> None:
    os.mkfifo(tmp_path / f"figure.{ending}")
    if ending == "csv":
        shutil.copyfile(gallery / "fig4_stability.png", tmp_path / "figure.png")
        _, out, err = explain(gallery, tmp_path, tmp_path / "figure.png")
        assert "figure.csv is altered since" in out + err
    else:
        assert "is not a regular file" in refused(tmp_path, "explain", tmp_path / f"figure.{ending}")


def test_options_are_never_passed_on_unknown(gallery: Path, tmp_path: Path) -> None:
    good = provenance.read(gallery / "training.png")
    for options in ({"statistic": "nonsense"}, {"store": "x"}, {"metrics": [["a"]], "group_by": 3}, {"metrics": {}}):
        figure = written(tmp_path / "figure.png", replace(good, options=options).as_json())
        code, out, err = explain(gallery, tmp_path, figure)
        assert (code, "cannot tell" in out + err) == (0, True)
