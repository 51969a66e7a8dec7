"""Heavy use of a PostgreSQL server: many writers at once, and a server that is killed while runs are trained."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ssmail.store import RunState, Store
from ssmail.store.maintenance.checks import check
from tests.store.postgres_server import PASSWORD, Server
from tests.store.test_contention import METRICS, WRITER, start_together

PROCESSES, RUNS, EPOCHS = 8, 5, 125  # with 20 metrics each: 100,000 rows
TRAIN = "train --method ssail --method bc --profile smoke --set training.epochs=25 --seeds 0-2 --jobs 3"


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
    command = [sys.executable, "-m", "ssmail_cli", *TRAIN.split()]
    settings = {name: value for name, value in os.environ.items() if not name.startswith("SSMAIL_")}
    settings["PYTHONPATH"] = os.pathsep.join(sys.path)
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
