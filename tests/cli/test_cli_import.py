"""`ssmail import-data`."""

import json
from pathlib import Path

import numpy as np
import pytest

from ssmail.data import expert_sets
from tests.cli.command_line import CommandLine
from tests.data import recorded_sets

HEADER = "scene,frame,agent,x,y\n"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    recorded_sets.write_crossing(tmp_path / "crossing.csv", scenes=5)
    return tmp_path / "crossing.csv"


def test_a_set_is_written_and_told_of(cli: CommandLine, table: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "set.npz"
    outcome = cli("import-data", table, "--out", out, "--window", 30, "--dt", 0.2)
    experts = expert_sets.load(out, "trajectories")
    assert outcome.code == 0
    heading, *splits, read, speeds, agents, unused, wrote = outcome.out.splitlines()
    assert heading.split() == ["split", "scenes", "windows", "agents"]
    assert [line.split() for line in splits] == [
        ["train", "3", "6", "5-5"],
        ["validation", "1", "2", "5-5"],
        ["test", "1", "2", "5-5"],
    ]
    assert read == "read 1,500 rows of 5 scenes from 1 file"
    assert speeds.startswith("speeds in units per second: median 1.")
    assert agents.startswith("agents: the same ones in all scenes, by their names; if they are not, import with --no-s")
    assert unused == f"rows in no window: {5 * 5 * (60 - 46)}"
    assert wrote == f"wrote {out}: hash {experts.hash[:16]}"
    assert outcome.err == "note: frames are numbered in steps of 5; windows count these steps\n"


def test_json_for_programs(cli: CommandLine, table: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.npz"
    options = ("--window", 20, "--observed", 8, "--stride", 5, "--agents", 3, "--split", "3/1/1")
    told = json.loads(cli("import-data", table, "--out", out, "--json", *options).out)
    experts = expert_sets.load(out)
    assert told["path"] == str(out)
    assert told["hash"] == experts.hash
    assert told["parameters"] == experts.parameters
    assert told["sources"] == experts.sources
    assert told["splits"]["test"] == {"scenes": 1, "windows": 8, "least_agents": 3, "most_agents": 3}
    assert told["left_out"]["agents of windows beyond --agents"] == 2 * 8 * 5
    assert {key: told["parameters"][key] for key in ("observed", "predicted", "stride", "most_agents", "split")} == {
        "observed": 8, "predicted": 12, "stride": 5, "most_agents": 3, "split": [3, 1, 1]
    }  # fmt: skip
    assert told["remarks"] == ["frames are numbered in steps of 5; windows count these steps"]


def test_agents_may_be_others_in_every_scene(cli: CommandLine, table: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.npz"
    told = {}
    for option in ("--same-agents", "--no-same-agents"):
        outcome = cli("import-data", table, "--out", out, "--force", option)
        told[option] = outcome.out.splitlines()[6]
        outcome = cli("import-data", table, "--out", out, "--force", option, "--json")
        same = expert_sets.load(out).parameters["identity"]
        assert json.loads(outcome.out)["same_agents"] is same is (option == "--same-agents")
    assert told["--same-agents"].startswith("agents: the same ones in all scenes, by their names;")
    assert told["--no-same-agents"] == "agents: not the same ones in all scenes"


def test_a_folder_is_imported_again_though_the_set_lies_in_it(cli: CommandLine, table: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.npz"
    first = cli("import-data", tmp_path, "--out", out)
    again = cli("import-data", tmp_path, "--out", out, "--force")
    assert (first.code, again.code, again.out) == (0, 0, first.out)
    assert f"leaving out {out}, which is the file to write" in again.err
    assert "leaving out" not in first.err
    other = cli("import-data", tmp_path, "--out", tmp_path / "other.npz")
    assert "set.npz is an expert set already" in other.sentence


@pytest.mark.parametrize("writer", ["write_boids", "write_coming_and_going", "write_boids_3d"])
def test_the_recorded_sets(cli: CommandLine, tmp_path: Path, writer: str) -> None:
    pytest.importorskip("pyarrow")
    getattr(recorded_sets, writer)(tmp_path / "a.parquet", scenes=4)
    out = tmp_path / "set.npz"
    assert cli("import-data", tmp_path / "a.parquet", "--out", out).code == 0
    experts = expert_sets.load(out, "trajectories")
    assert experts.parameters["axes"] == (3 if writer == "write_boids_3d" else 2)
    numbers = np.concatenate([experts.train.agents, experts.validation.agents, experts.test.agents])
    assert (len(set(numbers.tolist())) > 1) == (writer == "write_coming_and_going")
    assert experts.parameters["identity"] == (writer != "write_coming_and_going")


def test_the_walkers_choose_after_what_is_observed() -> None:
    walked = recorded_sets.crossing(scenes=12)
    group = walked[walked["agent"] == 1].pivot_table(index="scene", columns="frame", values="y")
    sides = np.sign(group[5 * 50])
    assert set(sides) == {-1, 1}
    assert (group[5 * 50].abs() > 1).all()
    assert (group[5 * 25].abs() < 0.5).all()


def test_an_existing_file_is_kept(cli: CommandLine, table: Path, tmp_path: Path) -> None:
    (tmp_path / "set.npz").write_text("mine")
    sentence = cli("import-data", table, "--out", tmp_path / "set.npz").sentence
    assert "exists already; choose another --out or overwrite it with --force" in sentence
    assert (tmp_path / "set.npz").read_text() == "mine"
    assert cli("import-data", table, "--out", tmp_path / "set.npz", "--force").code == 0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--out set.csv", "--out set.csv does not end in .npz, as the name of an expert set does; choose another"),
        ("--split 70/30", "--split takes three shares such as 70/15/15, not '70/30'; none may be 0"),
        ("--split 70/30/0", "none may be 0"),
        ("--dt 0", "--dt takes the seconds of a step, not 0; give a positive number"),
        ("--dt nan", "--dt takes the seconds of a step, not nan"),
        ("--observed 50", "of a window of 50 frames, 50 cannot be observed; give --observed from 1 to 49"),
        (
            "--window 60",
            "the three splits cannot each have windows of 60 frames, and one before, with an agent without a gap; the",
        ),
        ("--x px", "crossing.csv has no column 'px', only scene, frame, agent, x, y; name the one that it is with --x"),
        ("--x '' --y ''", "crossing.csv has no column ''"),
        ("--y '' --z y", "crossing.csv has no column for y beside z"),
    ],
)
def test_bad_options(cli: CommandLine, table: Path, tmp_path: Path, options: str, sentence: str) -> None:
    words = [word.replace("''", "") for word in options.split()]
    assert sentence in cli("import-data", table, "--out", tmp_path / "set.npz", *words).sentence
    assert [path.name for path in tmp_path.iterdir()] == [table.name]


def test_a_name_from_the_file_is_printed_harmlessly(cli: CommandLine, tmp_path: Path) -> None:
    text = HEADER + "".join(f"\x1b[31m,{frame},a,{frame},0\n" for frame in range(40)) + "\x1b[31m,3,a,1,1\n"
    (tmp_path / "a.csv").write_text(text)
    sentence = cli("import-data", tmp_path / "a.csv", "--out", tmp_path / "set.npz").sentence
    assert "agent a in frame 3 of scene \\x1b[31m is there already" in sentence
