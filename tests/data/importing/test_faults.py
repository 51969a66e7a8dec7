"""Tables and arrays that cannot be imported: one sentence each, with the place and the remedy."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ssmail.data.importing.tables import Columns
from ssmail.errors import InputError
from tests.data.importing.walks import imported, table_of, walks

GOOD = "scene,frame,agent,x,y\n" + "".join(f"{s},{f},{a},{f}.5,{s}\n" for s in range(3) for f in range(6) for a in "ab")
FAULTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "missing column": (
        GOOD.replace("agent", "id", 1),
        "a.csv has no column 'agent', only scene, frame, id, x, y; name the one that it is with --agent",
        {},
    ),
    "text in a number": (
        GOOD.replace("1,2,a,2.5", "1,2,a,east"),
        "a.csv, line 18: the column 'x' holds 'east', which is no number; correct it, or leave the row out",
        {},
    ),
    "text after an empty line": (
        GOOD.replace("\n0,1,b", "\n\n \n0,1,b").replace("1,2,a,2.5", "1,2,a,east"),
        "a.csv, line 20: the column 'x' holds 'east'",
        {},
    ),
    "text in a frame": (GOOD.replace("1,2,a", "1,two,a"), "a.csv, line 18: the column 'frame' holds 'two'", {}),
    "NaN": (GOOD.replace("2.5", "nan", 1), "a.csv, line 6: the column 'x' is empty or NaN; leave the row out", {}),
    "nothing": (GOOD.replace("2.5", "", 1), "a.csv, line 6: the column 'x' is empty or NaN; leave the row out", {}),
    "a short line": (GOOD.replace("0,2,a,2.5,0", "0,2,a"), "a.csv, line 6: the column 'x' is empty or NaN", {}),
    "a long line": (GOOD.replace("0,2,a,2.5,0", "0,2,a,2,5,0"), "a.csv, line 6 has 6 values instead of 5", {}),
    "infinity": (GOOD.replace("2.5", "inf", 1), "a.csv, line 6: the column 'x' holds 'inf', which is too large", {}),
    "no agent": (GOOD.replace("0,2,a,", "0,2,,"), "a.csv, line 6: an agent has no name; name each with 1 to 200", {}),
    "no scene": (GOOD.replace("1,2,b,", " ,2,b,"), "a.csv, line 19: a scene has no name; name each with 1 to", {}),
    "a long agent": (
        GOOD.replace("1,2,b,", f"1,2,{'b' * 201},"),
        "a.csv, line 19: an agent has a name of 201 characters; name each with 1 to 200",
        {},
    ),
    "a date": (
        GOOD.replace("0,2,a", "0,2026-11-28 17:07,a"),
        "a.csv, line 6: the column 'frame' holds '2026-11-28 17:07', which is no number; frames are whole numbers from "
        "0 on, or times in seconds if --dt gives the seconds of a frame",
        {},
    ),
    "a comment": (
        f"# made by us, today\n{GOOD}",
        "a.csv has no column 'frame'; its first line must be the header, and has the columns # made by us, today",
        {},
    ),
    "a header that is a comment": (
        f"# {GOOD}".replace("scene,frame", "frame,scene"),
        "a.csv has no column 'frame'; its first line must be the header, and has the columns # frame, scene, agent, x",
        {},
    ),
    "duplicate": (
        GOOD.replace("1,3,b", "1,2,b"),
        "a.csv, line 21: agent b in frame 2 of scene 1 is there already (a.csv, line 19); leave one out",
        {},
    ),
    "one frame": (
        GOOD + "7,3,a,1,1\n",
        "a.csv, line 38: the scene 7 has one frame only, so nothing moves in it; leave it out",
        {},
    ),
    "half a frame": (
        GOOD.replace("0,3,a", "0,3.5,a"),
        "a.csv, line 8: the frame 3.5 is no whole number; for times, give the seconds of a frame with --dt",
        {},
    ),
    "a time between frames": (
        GOOD.replace("0,3,a", "0,3.5,a"),
        "a.csv, line 8: the frame 3.5 is no whole number; that is no multiple of --dt 1",
        {"dt": 1.0},
    ),
    "a negative frame": (GOOD.replace("0,3,a", "0,-3,a"), "a.csv, line 8: the frame -3 is out of range", {}),
    "too long a window": (
        GOOD,
        "the three splits cannot each have windows of 50 frames, and one before, with an agent without a gap; the "
        "longest possible is --window 5",
        {"window": 50, "observed": 25},
    ),
    "too many agents": (
        GOOD,
        "the three splits cannot each have 3 agents together for 3 frames; raise --fill-gaps",
        {"least_agents": 3},
    ),
    "nothing moves": (
        "\n".join(line.rsplit(",", 2)[0] + ",1,1" if "." in line else line for line in GOOD.split("\n")),
        "nothing moves in the training windows of",
        {},
    ),
    "no header": (GOOD.split("\n", 1)[1].replace("a", "1").replace("b", "2"), "a.csv, line 1 has numbers instead", {}),
    "empty": ("", "a.csv has no header line", {}),
    "only a header": (GOOD.split("\n")[0], "a.csv has no rows; leave it out", {}),
    "a quotation mark": (GOOD.replace("1,2,a", '1,2,"a'), "a.csv has a quotation mark that is not closed", {}),
    "a column twice": (GOOD.replace("y\n", "x\n", 1), "a.csv has several columns 'x'; rename one of them", {}),
    "another column twice": (GOOD, "a.csv has one column for two of", {"columns": Columns(y="x")}),
    "everything observed": (
        GOOD,
        "of a window of 4 frames, 4 cannot be observed; give --observed from 1",
        {"observed": 4},
    ),
    "agents": (GOOD, "--agents 1 is less than --least-agents 2", {"most_agents": 1, "least_agents": 2}),
}


@pytest.mark.parametrize(("text", "sentence", "options"), FAULTS.values(), ids=FAULTS)
def test_a_bad_table_is_refused(
    tmp_path: Path, text: str, sentence: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        imported(Path("a.csv"), **options)
    assert sentence in str(caught.value)
    assert len(str(caught.value)) <= 300


def test_the_good_table_is_good(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    assert imported(tmp_path / "a.csv")[1].rows == 36


def test_the_longest_window_is_possible(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    assert len(imported(tmp_path / "a.csv", window=5)[0].test) == 1
    with pytest.raises(InputError, match="the longest possible is --window 5"):
        imported(tmp_path / "a.csv", window=6)


def test_no_window_on_the_grid(tmp_path: Path) -> None:
    late = "".join(f"{s},{f},a,{f},0\n" for s in range(3) for f in range(1, 6))
    text = "scene,frame,agent,x,y\n" + late + "".join(f"{s},0,b,0,0\n{s},1,b,0,0\n" for s in range(3))
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match="no window of 4 frames begins where --stride 2 looks for it; lower --stride"):
        imported(tmp_path / "a.csv")
    assert len(imported(tmp_path / "a.csv", stride=1)[0].train) == 1


def test_files_of_different_axes(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", walks(axes=2))
    np.save(tmp_path / "b.npy", walks(axes=3))
    with pytest.raises(InputError, match=r"b\.npy has 3 axes and .*a\.npy 2; import them apart"):
        imported(tmp_path)
    table_of(walks()).to_csv(tmp_path / "a.csv", index=False)
    table_of(walks(axes=3)).to_csv(tmp_path / "b.csv", index=False)
    both = (tmp_path / "a.csv", tmp_path / "b.csv")
    with pytest.raises(
        InputError, match=r"b\.csv has 3 axes and .*a\.csv 2; import them apart, or only the axes that bo"
    ):
        imported(*both)
    with pytest.raises(
        InputError, match=r"b\.csv, line 2: agent 0 in frame 0 of scene 0 is there already .*a\.csv, line"
    ):
        imported(*both, columns=Columns(z=""))


ARRAYS: dict[str, tuple[Any, str]] = {
    "three axes": (walks()[0], "has the shape 9x2x2 instead of (scenes, frames, agents, axes)"),
    "four coordinates": (walks(axes=4), "has the shape 4x9x2x4 instead of"),
    "NaN": (
        np.where(np.arange(144).reshape(4, 9, 2, 2) == 41, np.nan, walks()),
        "holds nan at [1, 1, 0, 1]; give every",
    ),
    "text": (np.full((4, 9, 2, 2), "x"), "no array of numbers"),
    "an object": (np.array([{}]), "no array of numbers"),
    "other numbers": (walks().astype(complex), "no array of numbers"),
    "one frame": (walks(frames=1), "scene 0, frame 0: the scene a/0 has one frame only"),
}


@pytest.mark.parametrize(("array", "sentence"), ARRAYS.values(), ids=ARRAYS)
def test_a_bad_array_is_refused(tmp_path: Path, array: np.ndarray, sentence: str) -> None:
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(InputError) as caught:
        imported(tmp_path / "a.npy")
    assert sentence in str(caught.value)
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-3])
    with pytest.raises(InputError, match=r"a\.npy"):
        imported(tmp_path / "a.npy")


def test_sources_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("")
    np.savez(tmp_path / "two.npz", a=walks(), b=walks())
    for source, sentence in {
        "absent.csv": "there is no file",
        "absent": "there is no file or folder .*absent; name another",
        "a.md": r"ends in none of \.csv, \.tsv, \.txt, \.parquet, \.npy, \.npz; save it as one of them",
        "two.npz": "holds 2 arrays, none of them called positions",
    }.items():
        with pytest.raises(InputError, match=sentence):
            imported(tmp_path / source)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"no file in .*folder ends in one of"):
        imported(tmp_path / "folder")
    table_of(walks()).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"two files are called .*a, apart from their suffix; name each once"):
        imported(tmp_path / "a.csv", tmp_path / "a.csv")


def test_parquet_faults(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    table = table_of(walks())

    def refused(changed: pd.DataFrame, sentence: str) -> None:
        changed.to_parquet(tmp_path / "a.parquet")
        with pytest.raises(InputError, match=sentence):
            imported(tmp_path / "a.parquet")

    refused(table.drop(columns="x"), r"a\.parquet has no column 'x', only scene, frame, agent, y")
    refused(table.assign(x="east"), r"the column 'x' of .*a\.parquet holds .*string values, no numbers")
    refused(table.assign(x=table["x"].where(table.index != 9)), r"a\.parquet, row 10: the column 'x' is empty or NaN")
    refused(table.assign(agent=table["agent"].where(table.index != 9)), r"row 10: the column 'agent' is empty or NaN")
    refused(
        table.astype({"agent": str}).replace({"agent": {"1": ""}}), r"a\.parquet, row 2: an agent has no name; name"
    )
    refused(
        table.assign(frame=pd.Timestamp("2026-11-28")),
        r"the column 'frame' of .*a\.parquet holds .* values, no numbers; frames are whole numbers from 0 on, or times",
    )
    refused(pd.concat([table, table[5:6]]), r"row 73: agent 1 in frame 2 of scene 0 is there already .*row 6\)")
    (tmp_path / "a.parquet").write_bytes((tmp_path / "a.parquet").read_bytes()[:-9])
    with pytest.raises(InputError, match=r"a\.parquet cannot be read as Parquet"):
        imported(tmp_path / "a.parquet")


def test_parquet_needs_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    with pytest.raises(
        InputError, match=r"a\.parquet needs pyarrow to be read; install it with `pip install 'ssmail\[p"
    ):
        imported(tmp_path / "a.parquet")
