"""Sweeps as jobs of a real SLURM on this machine: the commands of docs/cluster.md."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ssmail.store import Store
from tests.execution.launched import LONG, SLURM, SWEEP, FrontEnd, Numbers, computed_locally, numbers
from tests.execution.slurm_cluster import Cluster
from tests.store.postgres_server import PASSWORD, Server

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def slurm() -> Iterator[Cluster]:
    pytest.importorskip("submitit", reason="submitit, of the extra slurm, is not installed")
    cluster = Cluster()
    yield cluster
    cluster.close()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.close()


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Numbers:
    """The numbers of the long sweep without a launcher."""
    return computed_locally(tmp_path_factory.mktemp("local"), LONG)


def test_the_sweep_as_an_array_gives_the_numbers_of_the_local_one(slurm: Cluster, tmp_path: Path) -> None:
    here = (*SLURM, "--launcher-set", f"nodelist={slurm.host}")
    outcome = FrontEnd(tmp_path / "slurm", *SWEEP, *here, **slurm.environment).end()
    assert outcome.code == 0, outcome.err
    assert [row["outcome"] for row in outcome.rows] == ["finished"] * 4
    assert "ssail, seed 1: epoch 3/3" in outcome.err
    assert numbers(tmp_path / "slurm") == computed_locally(tmp_path / "local", SWEEP)
    jobs = tmp_path / "slurm" / "results" / "slurm"
    (script,) = jobs.glob("*_submission.sh")
    assert "--array=0-3%4" in script.read_text()
    assert "--time=120" in script.read_text()
    assert list(jobs.glob("*.pkl")) == []


def test_the_sweep_with_a_server_gives_the_same_numbers(
    slurm: Cluster, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seeds of a spec in one job, and the password in the environment."""
    database = server.new_database()
    settings = (*SLURM, "--launcher-set", "cells=2", "--jobs", "2")
    secret = {"SSMAIL_DB": server.url(database, None), "PGPASSWORD": PASSWORD}
    outcome = FrontEnd(tmp_path / "slurm", *SWEEP, *settings, **secret, **slurm.environment).end()
    assert outcome.code == 0, outcome.err
    assert [row["outcome"] for row in outcome.rows] == ["finished"] * 4
    (script,) = (tmp_path / "slurm" / "results" / "slurm").glob("*_submission.sh")
    assert "--array=0-1%2" in script.read_text()
    monkeypatch.chdir(tmp_path / "slurm")  # where its checkpoints are
    assert numbers(tmp_path, server.url(database)) == computed_locally(tmp_path / "local", SWEEP)


def cancelled(slurm: Cluster, job: str, _: FrontEnd) -> None:
    slurm.command("scancel", job)


def preempted(slurm: Cluster, job: str, _: FrontEnd) -> None:
    slurm.command("scancel", "--signal=USR2", job)


def ctrl_c(_: Cluster, __: str, front: FrontEnd) -> None:
    front.process.send_signal(signal.SIGINT)


@pytest.mark.parametrize(("disturb", "code"), [(cancelled, 130), (preempted, 0), (ctrl_c, 130)])
def test_a_sweep_that_was_disturbed_ends_with_the_same_numbers(
    slurm: Cluster, long: Numbers, tmp_path: Path, disturb: Callable[[Cluster, str, FrontEnd], None], code: int
) -> None:
    front = FrontEnd(tmp_path, *LONG, *SLURM, **slurm.environment)
    front.wait_for("seed 0: epoch 12/120")
    running = slurm.command("squeue", "--noheader", "--array", "--format=%i", "--name=ssmail").split()
    (first,) = [job for job in running if job.endswith("_0")]
    disturb(slurm, first, front)
    outcome = front.end()
    assert outcome.code == code, outcome.err
    if code:
        assert outcome.rows[0]["outcome"] == "interrupted"
        assert "interrupted; the same command continues where it stopped" in outcome.err
        again = FrontEnd(tmp_path, *LONG, *SLURM, **slurm.environment).end()
        assert again.code == 0, again.err
    assert numbers(tmp_path) == long
    store = Store.open(tmp_path / "results" / "ssmail.db")
    assert {row.seed: row.resumes for row in store.runs()}[0] == 1  # it was hit in the middle
