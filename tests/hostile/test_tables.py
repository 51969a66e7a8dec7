"""Tables and arrays from others, for `ssmail import-data`."""

import io
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hostile.harness import cases, hold, mutated, refused, time_limit

ONE = st.integers(0, 2**63 - 1)  # seeds
POSITIONS = np.random.default_rng(0).normal(size=(4, 9, 2, 2)).cumsum(axis=1)
OPTIONS = ("--window", "4", "--fill-gaps", "2")


def _table() -> pd.DataFrame:
    scene, frame, agent = (index.ravel() for index in np.indices(POSITIONS.shape[:3]))
    x, y = POSITIONS.reshape(-1, 2).T
    return pd.DataFrame({"scene": scene, "frame": frame, "agent": agent, "x": x, "y": y})


def _saved(save: Callable[[io.BytesIO], object]) -> bytes:
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def _parquet(file: io.BytesIO) -> None:
    pytest.importorskip("pyarrow")
    _table().to_parquet(file)


WRITERS: dict[str, Callable[[io.BytesIO], object]] = {
    "a.csv": lambda file: _table().to_csv(file, index=False),
    "a.npy": lambda file: np.save(file, POSITIONS),
    "a.npz": lambda file: np.savez_compressed(file, positions=POSITIONS),
    "a.parquet": _parquet,
}


@pytest.mark.parametrize("name", WRITERS)
@given(seed=ONE)
@cases(quick=15, fuzz=150)
def test_damaged_files(tmp_path: Path, name: str, seed: int) -> None:
    (tmp_path / name).write_bytes(mutated(_saved(WRITERS[name]), seed))
    hold(tmp_path, "import-data", tmp_path / name, "--out", tmp_path / "set.npz", "--force", *OPTIONS)


CELLS = (
    "",
    "nan",
    "inf",
    "-1",
    "1e999",
    "9" * 400,
    "0x10",
    "1_0",
    "east",
    "\x1b[31m",
    "\u202e",
    '"',
    "1e300",
    "2.5",
    "é",
)
CELLS += ("=1+1", "http://example.org/a.csv", "../../etc/passwd", "\0", "1e17", "1099511627776", "None", " ", ",", "\n")


@given(data=st.data())
@cases(quick=30, fuzz=300)
def test_odd_cells(tmp_path: Path, data: st.DataObject) -> None:
    rows = _table().astype(object).astype(str).to_numpy().tolist()
    for _ in range(data.draw(st.integers(1, 3))):
        row, column = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, 4))
        rows[row][column] = data.draw(st.sampled_from(CELLS))
    lines = ["scene,frame,agent,x,y", *map(",".join, rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines), encoding="utf-8", newline="")
    hold(tmp_path, "import-data", tmp_path / "a.csv", "--out", tmp_path / "set.npz", "--force", *OPTIONS)


SENTENCES = {
    b"": "has no header line",
    b"\0\0\0": "has no header line",
    b"\xff\xfe": "is not UTF-8 text",
    b"x" * 10**6: "has no header line",
    b"a,b,c\n1,2,3\n": "has no column 'frame'",
    b"," * 5000: "has 5,001 columns; have one row per agent and frame",
    b"scene,frame,agent,x,y\n" + b"1," * 10**5: "",
    b"scene,frame,agent,x,y\n1,1,1,1,\xff\n": "",
    b"scene,frame,agent,x,y\n0,0,a,0,0\n0,1099511627775,a,1,1\n": "the three splits cannot",
}


@pytest.mark.parametrize(("contents", "sentence"), SENTENCES.items())
def test_files_that_are_no_tables(tmp_path: Path, contents: bytes, sentence: str) -> None:
    (tmp_path / "a.csv").write_bytes(contents)
    assert sentence in refused(tmp_path, "import-data", tmp_path / "a.csv", "--out", tmp_path / "set.npz", *OPTIONS)


def test_gaps_that_would_fill_the_memory(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("frame,agent,x\n0,a,0\n1,a,1\n1000000000000,a,2\n")
    options = ("--fill-gaps", "1000000000000", "--out", tmp_path / "set.npz")
    assert "filled gaps make more than" in refused(tmp_path, "import-data", tmp_path / "a.csv", *options)


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npy", "npz"])
def test_sources_that_are_no_files(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    (tmp_path / f"device.{suffix}").symlink_to("/dev/zero")
    (tmp_path / f"circle.{suffix}").symlink_to(f"circle.{suffix}")
    with time_limit(10):
        for name in ("pipe", "device", "circle"):
            refused(tmp_path, "import-data", tmp_path / f"{name}.{suffix}", "--out", tmp_path / "set.npz")
        refused(tmp_path, "import-data", tmp_path, "--out", tmp_path / "set.npz")
    assert refused(tmp_path, "import-data", f"http://localhost/a.{suffix}", "--out", tmp_path / "set.npz").startswith(
        "there is no file"
    )
