"""Heavy use of a PostgreSQL server: many writers and workers at once, of which one or the server itself is killed."""

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pandas as pd
import pytest

from ssmail.paper.csv_comparison import first_difference
from ssmail.store import RunState, Store
from ssmail.store.maintenance.checks import check
from tests.cli.test_cli_killed import children_of, figures
from tests.execution.recorded import recorded
from tests.store.postgres_server import PASSWORD, Server
from tests.store.test_contention import METRICS, WRITER, start_together

PROCESSES, RUNS, EPOCHS = 8, 5, 125  # with 20 metrics each: 100,000 rows
WORKERS = 4
TRAIN = "train --method ssail --method bc --profile smoke --set training.epochs=25 --seeds 0-2 --jobs 3"
SSMAIL = (sys.executable, "-m", "ssmail_cli")


def environment(**others: str) -> dict[str, str]:
    """The environment of a command, without settings for ssmail except those."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SSMAIL_")}
    return {**kept, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", **others}


def start_workers(
    folder: Path, url: str, settings: dict[str, str], count: int, idle: int = 0
) -> "list[subprocess.Popen[bytes]]":
    """Start workers that end when nothing waits for a time; each has a log of its own, worker 0.log and so on."""
    started = []
    for number in range(count):
        with (folder / f"worker {number}.log").open("wb") as log:
            words = [*SSMAIL, "worker", "--idle-exit", str(idle), "--device", "cpu", "--db", url]
            started.append(subprocess.Popen(words, cwd=folder, env=settings, stdout=log, stderr=log))
    return started


def lines_with(folder: Path, word: str) -> list[int]:
    """How many lines of the log of each worker have a word."""
    logs = sorted(folder.glob("worker *.log"))
    return [sum(word in line for line in log.read_text().splitlines()) for log in logs]


@pytest.mark.slow
def test_eight_processes_make_a_database_and_lose_nothing_of_100_000_rows(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command, sizes = [sys.executable, str(WRITER), url], [str(RUNS), str(EPOCHS), "120"]
    assert (
        start_together([[*command, str(RUNS * process), *sizes] for process in range(PROCESSES)])
        == [(0, "")] * PROCESSES
    )
    store = Store.open(url)
    runs = store.runs()
    assert sorted(run.seed for run in runs) == list(range(PROCESSES * RUNS))
    assert {run.state for run in runs} == {RunState.FINISHED}
    frame = store.metrics([run.id for run in runs])
    assert len(frame) == PROCESSES * RUNS * EPOCHS * METRICS == 100_000
    number = frame["name"].str.removeprefix("metric/").astype(int)
    assert (frame["value"] == frame["seed"] + frame["step"] / 1000 + number).all()
    assert all((store.array(run.id, "x") == run.seed).all() for run in runs)
    assert [problem for problem in check(url) if problem.check != "final metrics"] == []
    store.close()


@pytest.mark.slow
def test_a_server_that_is_killed_in_mid_training_changes_no_number(server: Server, url: str, tmp_path: Path) -> None:
    """It is killed and started again three times; no run fails, and all are as if nothing had happened."""
    command, settings = [*SSMAIL, *TRAIN.split()], environment()
    log = tmp_path / "log"
    Store.open(url).close()
    with log.open("wb") as output:
        training = subprocess.Popen([*command, "--db", url], cwd=tmp_path, env=settings, stdout=output, stderr=output)
        for kill in range(3):
            while training.poll() is None and log.read_text().count("epoch ") < 20 * kill + 10:
                time.sleep(0.05)
            assert training.poll() is None, log.read_text()
            server.kill()
            time.sleep(1)
            server.start()
        assert training.wait() == 0, log.read_text()
    assert PASSWORD not in log.read_text()
    subprocess.run([*command, "--db", "calm.db"], cwd=tmp_path, env=settings, check=True, capture_output=True)
    calm, stormy = Store.open(tmp_path / "calm.db"), Store.open(url)
    values = []
    for store in (calm, stormy):
        runs = {run.id: run for run in store.runs(state="finished")}
        assert [run.resumes for run in runs.values()] == [0] * 6
        frame = store.metrics([*runs])
        cells = [(runs[run_id].method, runs[run_id].seed) for run_id in frame["run_id"]]
        rows = zip(cells, frame["name"], frame["step"], map(repr, frame["value"]), strict=True)
        values.append(sorted(row for row in rows if row[1] != "seconds"))
        store.close()
    assert len(values[0]) > 1000
    assert values[0] == values[1]


def difference(name: str, was: str, now: str) -> str | None:
    """The first line in which a figure's CSV differs from another."""
    table = pd.read_csv(io.StringIO(now), keep_default_na=False, na_values=["nan"])
    return first_difference(name, was, table)


@pytest.mark.slow
def test_the_smoke_by_four_workers_has_the_figures_of_a_single_process(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walking = os.environ.get("SSMAIL_CMU_DIR", "")
    nine = bool(walking) and Path(walking).is_dir()
    settings = environment(**({"SSMAIL_CMU_DIR": walking} if nine else {}))
    command = [*SSMAIL, "reproduce", "--profile", "smoke", "--jobs", "1", "--device", "cpu"]

    def run(folder: str, *words: str) -> str:
        (tmp_path / folder).mkdir(exist_ok=True)
        done = subprocess.run(
            [*command, *words], cwd=tmp_path / folder, env=settings, capture_output=True, text=True, check=False
        )
        assert done.returncode == (0 if nine or "--enqueue" in words else 3), done.stderr
        return done.stdout

    assert run("shared", "--enqueue", "--db", url).count(",queued,") == (40 if nine else 30)
    workers = start_workers(tmp_path / "shared", url, settings, WORKERS)
    assert [worker.wait() for worker in workers] == [0] * WORKERS
    assert min(lines_with(tmp_path / "shared", "finished (run")) > 0
    monkeypatch.chdir(tmp_path / "shared")
    store = Store.open(url)
    runs = store.runs()
    store.close()
    assert len({(row.spec_hash, row.seed) for row in runs}) == len(runs) == sum(lines_with(Path(), "finished (run"))
    assert {(row.state, row.resumes) for row in runs} == {(RunState.FINISHED, 0)}
    run("shared", "--db", url)
    run("calm", "--db", "results/ssmail.db")
    shared = figures(tmp_path / "shared/results/figures", url)
    calm = figures(tmp_path / "calm/results/figures", tmp_path / "calm/results/ssmail.db")
    assert len(calm) == (9 if nine else 7)
    assert calm.keys() == shared.keys()
    assert [found for name in calm if (found := difference(name, calm[name], shared[name]))] == []
    wrong = re.sub(r"0\.(\d{3})", "0.9\\1", shared["fig4_stability.csv"], count=1)  # negative control
    assert difference("fig4_stability.csv", calm["fig4_stability.csv"], wrong)


@pytest.mark.slow
def test_the_cells_of_a_killed_worker_are_computed_by_the_others(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings, words = environment(SSMAIL_STALE_SECONDS="20"), TRAIN.split()
    subprocess.run([*SSMAIL, *words, "--db", "calm.db"], env=settings, check=True, capture_output=True)
    subprocess.run([*SSMAIL, *words, "--enqueue", "--db", url], env=settings, check=True, capture_output=True)
    workers = start_workers(tmp_path, url, settings, 3, idle=40)  # longer than a dead one is waited for
    store = Store.open(url)
    while store.metrics([row.id for row in store.runs(state="running")], ["seconds"]).empty:
        assert None in [worker.poll() for worker in workers]
        time.sleep(0.2)
    frame = store.metrics([row.id for row in store.runs(state="running")], ["seconds"])
    begun = f"started (run {frame['run_id'].iloc[0][:8]})"
    victim = lines_with(tmp_path, begun).index(1)
    for pid in (workers[victim].pid, *children_of(workers[victim].pid)):
        os.kill(pid, signal.SIGKILL)
    codes = [worker.wait() for worker in workers]
    assert codes.pop(victim) == -signal.SIGKILL
    assert codes == [0, 0], [path.read_text() for path in tmp_path.glob("worker*.log")]
    calm, runs = Store.open("calm.db"), store.runs()
    assert Counter((row.state, row.resumes > 0) for row in runs)[RunState.FINISHED, True] > 0  # the kill hit something
    assert {row.state for row in runs} == {RunState.FINISHED}
    both = [{(row.method, row.seed): recorded(one, row.id) for row in one.runs()} for one in (store, calm)]
    assert len(both[0]) == len(runs) == 6
    for part, name in enumerate(("metrics", "arrays", "checkpoints")):
        assert [cell for cell in both[0] if both[0][cell][part] != both[1][cell][part]] == [], name
    for each in (store, calm):
        each.close()
