"""`ssmail runs`: what is stored, listed, compared, exported and deleted."""

import json
import math
import sqlite3
import statistics
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.experiments import build_spec
from ssmail.store import RunState, Store
from ssmail_cli.run_table import ENVIRONMENT_METRICS
from tests.cli.command_line import CommandLine

ERRORS = {0: 0.004, 1: 0.006, 2: 0.011}
KEY_METRICS = list(ENVIRONMENT_METRICS["yjunction"].compared)
AddRun = Callable[..., str]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "ssmail.db")


@pytest.fixture
def add(store: Store) -> AddRun:
    """add(seed, error, *overrides, state=..., method=..., environment=...) -> id of a run of three epochs."""

    def add_run(
        seed: int,
        error: float,
        *overrides: str,
        state: RunState = RunState.FINISHED,
        method: str = "ssail",
        environment: str = "yjunction",
    ) -> str:
        spec = build_spec(method, environment, "smoke", overrides)
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu", repeat=True)
        for epoch in (1, 2, 3):
            losses = {"critic/loss": math.inf if epoch == 2 else 0.5}
            writer.epoch(epoch, {ENVIRONMENT_METRICS[environment].validation: error * epoch, **losses})
        if state is RunState.FINISHED:
            writer.final(3, dict.fromkeys(ENVIRONMENT_METRICS[environment].compared, error))
        if state is not RunState.RUNNING:
            writer.finish(state, None if state is RunState.FINISHED else f"it {state}")
        return writer.run_id

    return add_run


@pytest.fixture
def filled(add: AddRun) -> dict[str, str]:
    """Three seeds of one spec, and of another one finished and one diverged seed."""
    ids = {f"plain {seed}": add(seed, error) for seed, error in ERRORS.items()}
    ids["other 0"] = add(0, 0.1, "sac.gamma=0.5")
    ids["other 1"] = add(1, 0.2, "sac.gamma=0.5", state=RunState.DIVERGED)
    return ids


@pytest.fixture
def runs(cli: CommandLine, store: Store) -> CommandLine:
    """runs("list", ...) on the store."""
    return lambda command, *arguments: cli("runs", command, *arguments, "--db", store.where)


def test_without_a_terminal_a_list_is_csv_with_every_column(runs: CommandLine, filled: dict[str, str]) -> None:
    rows = runs("list").rows
    assert [row["id"] for row in rows] == list(filled.values())  # newest last
    assert rows[1]["test/mode_mse"] == "0.006"
    assert rows[4]["state"] == "diverged"
    assert rows[4]["test/mode_mse"] == ""
    assert {"git_commit", "host", "wall_seconds", "dataset_hash"} <= rows[0].keys()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], ["plain 0", "plain 1", "plain 2", "other 0", "other 1"]),
        (["--state", "diverged"], ["other 1"]),
        (["--method", "ssail", "--env", "yjunction", "--profile", "smoke"], None),
        (["--figure", "fig5", "--state", "finished"], ["plain 0", "plain 1", "plain 2", "other 0"]),
        (["--figure", "modes", "--state", "finished"], ["plain 0", "plain 1", "plain 2", "other 0"]),
        (["--method", "gail"], []),
        (["--env", "mocap"], []),
        (["--profile", "quick"], []),
    ],
)
def test_filters(runs: CommandLine, filled: dict[str, str], options: list[str], expected: list[str] | None) -> None:
    names = {run_id: name for name, run_id in filled.items()}
    outcome = runs("list", "--json", *options)
    assert outcome.code == 0
    found = [names[row["id"]] for row in json.loads(outcome.out)]
    assert found == (list(filled) if expected is None else expected)
    assert ("no run" in outcome.err) == (not found)


def test_runs_are_named_by_their_first_digits(runs: CommandLine, filled: dict[str, str]) -> None:
    wanted = [filled["plain 2"], filled["other 0"]]
    rows = json.loads(runs("list", *(run_id[:10] for run_id in wanted), "--json").out)
    assert [row["id"] for row in rows] == wanted


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["list", "--state", "finishd"], "unknown state 'finishd'; did you mean finished?"),
        (["list", "--figure", "figg4"], "unknown figure 'figg4'; did you mean fig4?"),
        (["show", "zzzz"], "no run id starts with 'zzzz'"),
        (["compare", "--metric", "test/nothing"], "no run compared here has a metric 'test/nothing'"),
        (["export", "--format", "table"], "an export is csv or json, not a table"),
        (["export", "--format", "latex"], "an export is csv or json, not a table"),
        (["list", "--where", "gamma=1"], "no run here has a key or metric 'gamma'; did you mean sac.gamma?"),
        (["compare", "--where", "sac.gamma"], "'sac.gamma' is no condition; write one as "),
        (["list", "--sort", "mode_mse"], "no run here has a key or metric 'mode_mse'; did you mean test/mode_mse?"),
        (["list", "--descending"], "--descending is for --sort; name what to sort by"),
        (["export", "--out", "/proc/none.csv"], "/proc/none.csv cannot be written"),
    ],
)
def test_bad_input(runs: CommandLine, filled: dict[str, str], arguments: list[str], sentence: str) -> None:
    assert sentence in runs(*arguments).sentence


def test_a_table_has_short_ids_and_fits_80_columns(
    runs: CommandLine, filled: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = runs("list", "--format", "table").out.splitlines()
    assert len(lines) == 2 + len(filled)  # nothing is folded
    assert lines[-1] == "left out, as the terminal is narrow: spec, start (UTC)"
    assert max(map(len, lines)) <= 80
    assert "smoke + sac.gamma=0.5" in lines[4]
    assert filled["plain 1"][:8] in lines[2]
    assert filled["plain 1"][:9] not in lines[2]
    assert "0.006" in lines[2]


def test_a_changed_spec_is_told_wherever_a_run_is_shown(runs: CommandLine, filled: dict[str, str]) -> None:
    rows = runs("list").rows
    assert [row["settings"] for row in rows] == ["smoke"] * 3 + ["smoke + sac.gamma=0.5"] * 2
    assert [row["changes"] for row in rows[2:4]] == ["{}", '{"sac.gamma": 0.5}']
    shown = {row["name"]: row["value"] for row in runs("show", filled["other 0"]).rows if row["section"] == "run"}
    assert (shown["profile"], shown["settings"], shown["changes.sac.gamma"]) == (
        "smoke",
        "smoke + sac.gamma=0.5",
        "0.5",
    )
    table = runs("compare", "--format", "table").out
    (plain, other) = (line for line in table.splitlines() if line.startswith("ssail on "))
    assert f"profile smoke, spec {build_spec('ssail', 'yjunction', 'smoke').hash()[:8]}, sac.gamma=0.95" in plain
    assert "profile smoke + sac.gamma=0.5, spec " in other
    assert other.count("0.5") == 1
    assert {item["settings"] for item in json.loads(runs("compare", "--json").out)} == {
        "smoke",
        "smoke + sac.gamma=0.5",
    }


def listed(outcome: Any, names: dict[str, str]) -> list[str]:
    found = {run_id: name for name, run_id in names.items()}
    return [found[row["id"]] for row in outcome.rows]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--where", "sac.gamma=0.5"], ["other 0", "other 1"]),
        (["--where", "sac.gamma!=0.5", "--where", "test/mode_mse<0.01"], ["plain 0", "plain 1"]),
        (["--where", "test/mode_mse>0", "--sort", "-test/mode_mse"], ["other 0", "plain 2", "plain 1", "plain 0"]),
        (["--sort", "test/mode_mse", "--descending", "--limit", "2"], ["other 0", "plain 2"]),
        (["--limit", "2"], ["other 0", "other 1"]),
        (["--where", "seed=0", "--sort", "sac.gamma"], ["other 0", "plain 0"]),
    ],
)
def test_conditions_order_and_limit(
    runs: CommandLine, filled: dict[str, str], options: list[str], expected: list[str]
) -> None:
    assert listed(runs("list", *options), filled) == expected


def test_what_is_named_has_a_column(runs: CommandLine, filled: dict[str, str]) -> None:
    options = ("--where", "sac.gamma<0.9", "--sort", "test/on_path", "--where", "seed<5")
    (first, _) = rows = runs("list", *options).rows
    assert (first["sac.gamma"], first["test/on_path"]) == ("0.5", "0.1")
    assert [row["sac.gamma"] for row in rows] == ["0.5", "0.5"]
    (heads, *_) = runs("list", *options, "--format", "markdown").out.splitlines()
    assert "| gamma | test/on\\_path | mode\\_mse |" in heads


def test_specs_are_compared_in_order(runs: CommandLine, filled: dict[str, str]) -> None:
    def gammas(*options: str) -> list[float]:
        found = json.loads(runs("compare", "--metric", "test/on_path", *options, "--json").out)
        return [item["differs"].get("sac.gamma", "alone") for item in found]

    assert gammas() == [0.95, 0.5]
    assert gammas("--sort", "-test/mode_mse") == gammas("--sort", "sac.gamma") == [0.5, 0.95]
    assert gammas("--sort", "sac.gamma", "--limit", "1") == gammas("--where", "sac.gamma=0.5") == ["alone"]
    seeds = json.loads(runs("compare", "--where", "seed!=1", "--metric", "test/on_path", "--json").out)[0]["seeds"]
    assert list(seeds) == ["0", "2"]


def test_tables_for_documents(runs: CommandLine, filled: dict[str, str], add: AddRun) -> None:
    add(0, 0.03, method="dnri")
    options = ("--metric", "test/mode_mse", "--where", "seed<2")
    spec = build_spec("dnri", "yjunction", "smoke").hash()[:8]
    assert runs("compare", *options, "--format", "markdown").out.splitlines() == [
        "| spec | seeds | test/mode\\_mse |",
        "| --- | --- | --- |",
        "| ssail gamma 0.95 | 2/2 | 0.005 ± 0.0014 |",
        "| ssail gamma 0.5 | 1/2 | 0.1 |",
        f"| dnri {spec} | 1/1 | 0.03 |",
    ]
    assert runs("compare", *options, "--format", "latex").out.splitlines() == [
        r"\begin{tabular}{lll}",
        r"\toprule",
        r"spec & seeds & test/mode\_mse \\",
        r"\midrule",
        r"ssail gamma 0.95 & 2/2 & 0.005 $\pm$ 0.0014 \\",
        r"ssail gamma 0.5 & 1/2 & 0.1 \\",
        rf"dnri {spec} & 1/1 & 0.03 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_text_of_others_is_no_markup_in_a_document(runs: CommandLine, store: Store, add: AddRun) -> None:
    run_id = add(0, 0.1)
    with sqlite3.connect(store.where) as connection:
        odd = r"x|<b>*_`[l](u)\input{y}%&#$^~"
        connection.execute("UPDATE run SET host = ? WHERE id = ?", (odd, run_id))
    (line,) = (line for line in runs("show", run_id, "--format", "markdown").out.splitlines() if "| host |" in line)
    cell = r"x\|\<b\>\*\_\`\[l\](u)\\input\{y\}%\&\#\$^\~"
    assert line == f"| run | host | - | {cell} |"
    (row,) = (line for line in runs("show", run_id, "--format", "latex").out.splitlines() if "run & host &" in line)
    for command in (r"\input", "%&", "#$", " ^"):
        assert command not in row
    assert r"\textbackslash input\{y\}\%\&\#\$" in row


def test_show_tells_everything(runs: CommandLine, filled: dict[str, str]) -> None:
    shown = json.loads(runs("show", filled["plain 1"][:8], "--json").out)
    assert shown["run"]["id"] == filled["plain 1"]
    assert shown["spec"]["sac"]["gamma"] == build_spec("ssail", "yjunction", "smoke").sac.gamma
    values = {metric["name"]: metric["value"] for metric in shown["metrics"]}
    assert values["test/on_path"] == 0.006
    rows = {(row["section"], row["name"]): row["value"] for row in runs("show", filled["plain 1"]).rows}
    assert rows["run", "seed"] == "1"
    assert float(rows["spec", "sac.gamma"]) == shown["spec"]["sac"]["gamma"]
    assert rows["metric", "validation/mode_mse"] == str(3 * 0.006)


def test_compare_groups_by_everything_but_the_seed(runs: CommandLine, filled: dict[str, str]) -> None:
    found = json.loads(runs("compare", "--json", "--metric", "test/mode_mse").out)
    plain, other = found
    assert plain["mean"] == pytest.approx(0.007)
    assert plain["std"] == pytest.approx(statistics.stdev(ERRORS.values()))
    assert plain["median"] == 0.006
    assert plain["seeds"] == {"0": 0.004, "1": 0.006, "2": 0.011}
    assert (plain["runs"], plain["values"]) == (3, 3)
    assert other["seeds"] == {"0": 0.1, "1": "diverged"}  # counted and shown, never left out
    assert (other["runs"], other["values"], other["std"]) == (2, 1, None)
    assert list(other["differs"]) == ["sac.gamma"]
    assert other["differs"]["sac.gamma"] == 0.5


def test_compare_takes_the_newest_run_of_a_seed(runs: CommandLine, filled: dict[str, str], add: AddRun) -> None:
    add(1, 0.5)
    (plain,) = json.loads(runs("compare", "--json", "--metric", "test/mode_mse").out)[:1]
    assert plain["seeds"] == {"0": 0.004, "1": 0.5, "2": 0.011}


def test_compare_has_sensible_metrics_and_a_column_for_each_seed(runs: CommandLine, filled: dict[str, str]) -> None:
    rows = runs("compare").rows
    assert [row["metric"] for row in rows] == [*KEY_METRICS, *KEY_METRICS]
    assert (rows[0]["seed_0"], rows[0]["seed_2"]) == ("0.004", "0.011")
    assert (rows[-1]["seed_1"], rows[-1]["seed_2"]) == ("diverged", "")


def test_the_comparison_table_shows_seeds_and_states(
    runs: CommandLine, filled: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    table = runs("compare", "--format", "table").out
    assert max(map(len, table.splitlines())) <= 80
    assert "sac.gamma=0.5" in table
    assert "1 diverged" in table
    (median,) = {line.split()[1] for line in table.splitlines() if line.startswith("median")} - {"0.1"}
    assert median == "0.006"


def test_several_specs_get_an_overview_that_counts_their_seeds(
    runs: CommandLine, filled: dict[str, str], add: AddRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(0, 0.03, method="dnri")
    monkeypatch.setenv("COLUMNS", "200")
    table = runs("compare", "--format", "table", "--metric", "test/mode_mse").out
    overview = table[table.index("mean ± standard deviation") :]
    assert [line.split() for line in overview.splitlines()[-3:]] == [
        ["ssail", "gamma", "0.95", "3/3", "0.007", "±", "0.0036"],
        ["ssail", "gamma", "0.5", "1/2", "0.1"],
        ["dnri", build_spec("dnri", "yjunction", "smoke").hash()[:8], "1/1", "0.03"],
    ]
    assert "mean ±" not in runs("compare", "--format", "table", filled["plain 0"]).out


def test_specs_are_told_apart_within_their_method(runs: CommandLine, filled: dict[str, str], add: AddRun) -> None:
    """What one method has and another has not is no difference worth a column."""
    add(0, 0.03, method="dnri")
    found = json.loads(runs("compare", "--json", "--metric", "test/mode_mse").out)
    assert [list(item["differs"]) for item in found] == [["sac.gamma"], ["sac.gamma"], []]


@pytest.fixture
def mixed(filled: dict[str, str], add: AddRun) -> dict[str, str]:
    """The same, and three runs on mocap: two seeds of dnri and one of bc."""
    more = {f"mocap {seed}": add(seed, 0.02 + 0.02 * seed, method="dnri", environment="mocap") for seed in (0, 1)}
    return filled | more | {"mocap bc": add(0, 0.05, method="bc", environment="mocap")}


def test_a_list_shows_the_error_of_each_environment(
    runs: CommandLine, mixed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one column for people, under its name where that is one; in a column of its own for programs."""
    monkeypatch.setenv("COLUMNS", "80")
    for options, heading in (
        (["--env", "mocap"], "mse_40"),
        (["--env", "yjunction"], "mode_mse"),
        ([], "error"),
    ):
        lines = runs("list", "--format", "table", *options).out.splitlines()
        assert max(map(len, lines)) <= 80
        (heads,) = (line for line in lines if line.startswith("run "))
        assert heads.split()[-1] == heading
        last = {line.split()[0]: line.split()[-1] for line in lines}
        for name, error in (("mocap 1", "0.04"), ("plain 1", "0.006"), ("other 1", "-")):
            if mixed[name][:8] in last:
                assert last[mixed[name][:8]] == error
    rows = {row["id"]: row for row in runs("list").rows}
    assert (rows[mixed["mocap 1"]]["test/mse_40"], rows[mixed["mocap 1"]]["test/mode_mse"]) == ("0.04", "")
    assert (rows[mixed["plain 1"]]["test/mse_40"], rows[mixed["plain 1"]]["test/mode_mse"]) == ("", "0.006")


def test_each_environment_is_compared_by_its_own_metrics(
    runs: CommandLine, mixed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    by_spec = dict.fromkeys((row["environment"], row["spec_hash"]) for row in runs("compare").rows)
    assert [environment for environment, _ in by_spec] == ["yjunction", "yjunction", "mocap", "mocap"]
    for environment, spec in by_spec:
        found = [row["metric"] for row in runs("compare").rows if row["spec_hash"] == spec]
        assert found == list(ENVIRONMENT_METRICS[environment].compared)
    monkeypatch.setenv("COLUMNS", "200")
    table = runs("compare", "--format", "table").out
    _, lanes, motion = table.split(": mean ± standard deviation")
    assert lanes.splitlines()[-1] == "mocap"  # the end of the first overview is the heading of the second
    assert "on_path" in lanes
    assert "on_lane" not in table
    assert "mse_40" not in lanes
    assert "on_path" not in motion
    assert [line.split()[:6] for line in motion.splitlines()[-2:]] == [
        ["dnri", build_spec("dnri", "mocap", "smoke").hash()[:8], "2/2", "0.03", "±", "0.014"],
        ["bc", build_spec("bc", "mocap", "smoke").hash()[:8], "1/1", "0.05", "0.05", "0.05"],
    ]
    assert "mse_40" not in runs("compare", "--format", "table", "--env", "yjunction").out


def test_a_metric_that_is_asked_for_is_compared_in_every_environment(runs: CommandLine, mixed: dict[str, str]) -> None:
    found = json.loads(runs("compare", "--json", "--metric", "test/diverged").out)
    assert [(item["environment"], item["values"]) for item in found] == [
        ("yjunction", 3), ("yjunction", 1), ("mocap", 2), ("mocap", 1)
    ]  # fmt: skip
    only = json.loads(runs("compare", "--json", "--metric", "test_noisy/mse_40").out)
    assert [item["values"] for item in only] == [0, 0, 2, 1]


def test_show_tells_everything_of_a_run_on_mocap(runs: CommandLine, mixed: dict[str, str]) -> None:
    rows = {(row["section"], row["name"]): row["value"] for row in runs("show", mixed["mocap 1"]).rows}
    assert rows["metric", "test_noisy/mse_40"] == "0.04"
    assert rows["spec", "forecast.observed"] == "50"


def test_export_writes_every_value(runs: CommandLine, filled: dict[str, str], tmp_path: Path) -> None:
    rows = runs("export").rows
    assert len(rows) == 5 * 6 + 4 * len(KEY_METRICS)
    (infinite,) = (r for r in rows if (r["run_id"], r["name"], r["step"]) == (filled["plain 0"], "critic/loss", "2"))
    assert infinite["value"] == "inf"
    outcome = runs("export", filled["other 1"], "--json", "--out", tmp_path / "new" / "runs.json")
    assert outcome.out == ""
    (exported,) = json.loads((tmp_path / "new" / "runs.json").read_text())
    assert exported["spec"]["sac"]["gamma"] == 0.5
    values: list[Any] = [m["value"] for m in exported["metrics"] if m["name"] == "critic/loss"]
    assert values == [0.5, "inf", 0.5]


def test_an_export_reads_back_to_the_same_numbers(runs: CommandLine, filled: dict[str, str], store: Store) -> None:
    exported = {(row["run_id"], row["name"], row["step"]): float(row["value"]) for row in runs("export").rows}
    frame = store.metrics(list(filled.values()))
    keys = zip(frame["run_id"], frame["name"], frame["step"].astype(str), strict=True)
    assert exported == dict(zip(keys, frame["value"], strict=True))


def test_delete_asks_first(
    runs: CommandLine, filled: dict[str, str], store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_id = filled["other 1"]
    assert "give --yes to delete " + run_id[:8] in runs("delete", run_id).sentence
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", lambda *_, **__: False)
    assert runs("delete", run_id).code == 1
    assert len(store.runs()) == 5
    monkeypatch.setattr("typer.confirm", lambda *_, **__: True)
    assert runs("delete", run_id[:8]).code == 0
    assert run_id not in [run.id for run in store.runs()]
    assert runs("delete", filled["other 0"], filled["plain 0"], "--yes").code == 0
    assert [run.id for run in store.runs()] == [filled["plain 1"], filled["plain 2"]]


def test_a_run_that_is_being_computed_is_not_deleted(runs: CommandLine, add: AddRun, store: Store) -> None:
    run_id = add(0, 0.1, state=RunState.RUNNING)
    assert "being computed" in runs("delete", run_id, "--yes").sentence
    assert [run.id for run in store.runs()] == [run_id]


def test_an_empty_store_has_an_empty_list(runs: CommandLine, store: Store) -> None:
    for command in ("list", "compare"):
        outcome = runs(command, "--json")
        assert (outcome.code, json.loads(outcome.out)) == (0, [])
        assert "no run in" in outcome.err


def test_a_run_whose_process_died_is_shown_as_interrupted(runs: CommandLine, store: Store, add: AddRun) -> None:
    alive, dead = add(0, 0.1, state=RunState.RUNNING), add(1, 0.1, state=RunState.RUNNING)
    long_ago = (datetime.now(UTC) - timedelta(hours=1)).isoformat(sep=" ")
    with sqlite3.connect(store.where) as connection:
        stamp = connection.execute("SELECT heartbeat FROM run WHERE id = ?", (dead,)).fetchone()[0]
        connection.execute("UPDATE run SET heartbeat = ? WHERE id = ?", (long_ago[: len(stamp)], dead))
    listed = {row["id"]: row["state"] for row in json.loads(runs("list", "--json").out)}
    assert listed == {alive: "running", dead: "interrupted"}
