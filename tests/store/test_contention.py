"""Many processes at one database."""

import subprocess
import sys
from pathlib import Path

from ssmail.config.spec import RunSpec
from ssmail.store import RunState, Store

PROCESSES, RUNS, EPOCHS, METRICS = 8, 2, 15, 20
WRITER = Path(__file__).parent / "contending_writer.py"


def start_together(commands: list[list[str]]) -> list[tuple[int, str]]:
    """Run the commands at the same time, from a common starting shot on; (exit code, last line of stderr) of each."""
    pipe = subprocess.PIPE
    processes = [subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) for command in commands]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    said = [process.communicate()[1].strip().rpartition("\n")[2] for process in processes]
    return [(process.returncode, last) for process, last in zip(processes, said, strict=True)]


def write_at_once(where: Path, busy_seconds: float) -> list[tuple[int, str]]:
    command = [sys.executable, str(WRITER), str(where)]
    sizes = [str(RUNS), str(EPOCHS), str(busy_seconds)]
    return start_together([[*command, str(RUNS * process), *sizes] for process in range(PROCESSES)])


def test_eight_processes_lose_nothing_and_meet_no_lock(tmp_path: Path) -> None:
    where = tmp_path / "ssmail.db"  # not there yet: they also create it at the same time
    assert write_at_once(where, busy_seconds=120) == [(0, "")] * PROCESSES
    store = Store.open(where)
    runs = store.runs()
    assert sorted(run.seed for run in runs) == list(range(PROCESSES * RUNS))
    assert {run.state for run in runs} == {RunState.FINISHED}
    frame = store.metrics([run.id for run in runs])
    assert len(frame) == PROCESSES * RUNS * EPOCHS * METRICS
    number = frame["name"].str.removeprefix("metric/").astype(int)
    assert (frame["value"] == frame["seed"] + frame["step"] / 1000 + number).all()
    assert all((store.array(run.id, "x") == run.seed).all() for run in runs)
    store.close()


def test_without_waiting_they_would_meet_locks(tmp_path: Path) -> None:
    """Negative control: the same load, by writers that do not wait for their turn."""
    Store.open(tmp_path / "ssmail.db").close()
    results = write_at_once(tmp_path / "ssmail.db", busy_seconds=0)
    assert any(code == 1 and "locked the database" in last for code, last in results), results


CLAIM = """
import sys
from ssmail.config.experiments import build_spec
from ssmail.store import Store
store, spec = Store.open(sys.argv[1]), build_spec("ssail", "yjunction", "smoke")
print("ready", flush=True)
sys.stdin.readline()
if sys.argv[2] == "start":
    store.start_run(spec, 0, dataset_hash=None, device="cpu")
else:
    store.resume_run(sys.argv[2], 0)
"""


def claim_at_once(where: str, what: str) -> None:
    """Four processes want the same cell: one gets it, the others are told in one sentence."""
    results = start_together([[sys.executable, "-c", CLAIM, where, what]] * 4)
    assert sorted(code for code, _ in results) == [0, 1, 1, 1]
    assert {"is being computed by another process" in last for code, last in results if code} == {True}


def test_one_of_several_processes_gets_a_cell(store: Store, spec: RunSpec) -> None:
    claim_at_once(store.where, "start")
    (row,) = store.runs()
    assert row.state is RunState.RUNNING


def test_one_of_several_processes_gets_to_resume_a_run(store: Store, spec: RunSpec) -> None:
    writer = store.start_run(spec, 0, dataset_hash=None, device="cpu")
    writer.finish(RunState.INTERRUPTED)
    claim_at_once(store.where, writer.run_id)
    (row,) = store.runs()
    assert (row.state, row.resumes) == (RunState.RUNNING, 1)
