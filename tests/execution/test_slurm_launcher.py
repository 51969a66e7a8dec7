"""What the launcher of SLURM makes of the answers of sbatch and squeue, which are scripts here."""

import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ssmail.errors import InputError
from ssmail.execution.launchers import Ended

if TYPE_CHECKING:
    from ssmail.execution.slurm_launcher import SlurmLauncher

pytest.importorskip("submitit", reason="submitit, of the extra slurm, is not installed")
SCRIPTS = {
    "srun": "exit 1",
    "sbatch": 'cp "$1" "$FAKE/batch"; test -f "$FAKE/refuse" && { echo "sbatch: no such partition" >&2; exit 1; }; '
    'echo "Submitted batch job 7"',
    "squeue": 'test -f "$FAKE/queue" && cat "$FAKE/queue"',
    "scancel": 'echo "$@" >> "$FAKE/cancelled"',
}


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the scripts read and write."""
    for name, script in SCRIPTS.items():
        file = tmp_path / "bin" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"#!/bin/sh\n{script}\n")
        file.chmod(0o755)
    monkeypatch.setenv("FAKE", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)
    return tmp_path


def launcher(folder: Path, processes: int = 1, **settings: str) -> "SlurmLauncher":
    from ssmail.execution.slurm_launcher import SlurmLauncher

    return SlurmLauncher(settings, folder / "jobs", processes)


def end(folder: Path, job: str, *result: str) -> None:
    (folder / "jobs" / f"{job}_0_result.pkl").write_bytes(pickle.dumps(result))


def test_an_array_is_submitted_with_the_settings_and_followed_by_squeue(slurm: Path) -> None:
    opened = launcher(slurm, 2, partition="gpu", timeout="30", slurm_mem="4G", gpus="1", setup="module load cuda")
    assert opened.submit(["one", "two", "three"]) == ["7_0", "7_1", "7_2"]
    script = (slurm / "batch").read_text()
    for line in ("array=0-2%3", "partition=gpu", "time=30", "mem=4G", "gpus-per-node=1", "cpus-per-task=2"):
        assert f"#SBATCH --{line}\n" in script
    assert "\nmodule load cuda\n" in script
    assert (slurm / "jobs").stat().st_mode & 0o77 == 0
    assert opened.poll() == []  # squeue fails: the controller restarts
    (slurm / "queue").write_text("7_0|PENDING\n7_1|RUNNING\n7_2|COMPLETING\n6_0|FAILED\n")
    assert opened.poll() == []
    end(slurm, "7_0", "success", "the result")
    end(slurm, "7_1", "error", "Traceback\nValueError: planted")
    (slurm / "queue").write_text("7_0|COMPLETED\n7_1|FAILED\n7_2|CANCELLED\n")
    ended = {each.job: each for each in opened.poll()}
    assert ended["7_0"] == Ended("7_0", "the result")
    assert (ended["7_1"].kind, ended["7_1"].message) == ("failed", "its SLURM job 7_1 ended: ValueError: planted")
    assert (ended["7_2"].kind, ended["7_2"].message) == ("interrupted", "its SLURM job 7_2 ended as CANCELLED")
    assert opened.poll() == []
    assert list((slurm / "jobs").glob("*.pkl")) == []


def test_a_job_that_left_the_queue_without_a_result_is_waited_for_a_while(
    slurm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ssmail.execution import slurm_launcher

    opened = launcher(slurm)
    (name,) = opened.submit(["one"])
    (slurm / "queue").write_text("")
    assert opened.poll() == []
    monkeypatch.setattr(slurm_launcher, "_PATIENCE", 0.0)
    (slurm / "jobs" / f"{name}_0_log.err").write_text("\nslurmstepd: error: node vm lost\n\n")
    (ended,) = opened.poll()
    assert ended == Ended(name, None, "failed", "its SLURM job 7 is gone: slurmstepd: error: node vm lost")


def test_cancelling_is_one_command_for_an_array(slurm: Path) -> None:
    opened = launcher(slurm)
    opened.submit(["one", "two"])
    opened.cancel()
    assert (slurm / "cancelled").read_text() == "7\n"


def test_what_sbatch_says_against_a_job_is_one_sentence(slurm: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (slurm / "refuse").touch()
    with pytest.raises(InputError, match=r"^SLURM refused the jobs: sbatch: no such partition$"):
        launcher(slurm).submit(["one", "two"])
    assert capfd.readouterr().err == ""


def test_without_slurm_there_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="finds no `srun` on this machine"):
        launcher(tmp_path)


def test_a_job_that_was_asked_to_stop_leaves_its_end_to_slurm(monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that returned by itself would not be requeued."""
    from ssmail.execution import slurm_launcher

    waited: list[float] = []
    monkeypatch.setattr("time.sleep", waited.append)
    monkeypatch.setattr(slurm_launcher, "compute", lambda _: '{"kind": "finished"}')
    job = slurm_launcher.Resumable()
    assert (job("the job"), waited) == ('{"kind": "finished"}', [])
    monkeypatch.setattr(slurm_launcher, "compute", lambda _: '{"kind": "finished"}\n{"kind": "interrupted"}')
    job("the job")
    assert waited == [900.0]
    again = job.checkpoint("the job")
    assert (again.function, again.args) == (job, ("the job",))
