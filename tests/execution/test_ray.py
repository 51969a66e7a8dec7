"""Sweeps as tasks of a real Ray cluster on this machine: the commands of docs/cluster.md."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssmail.store import Store
from tests.execution.launched import LONG, SWEEP, FrontEnd, Numbers, computed_locally, numbers
from tests.execution.ray_cluster import RayCluster

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def ray_cluster() -> Iterator[RayCluster]:
    """Two nodes, of which the last test kills one."""
    cluster = RayCluster(2)
    yield cluster
    cluster.close()


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Numbers:
    """The numbers of the long sweep without a launcher."""
    return computed_locally(tmp_path_factory.mktemp("local"), LONG)


def on(cluster: RayCluster) -> tuple[str, ...]:
    return "--launcher", "ray", "--launcher-set", f"address={cluster.address},cpus=1"


def test_the_sweep_on_two_nodes_gives_the_numbers_of_the_local_one(ray_cluster: RayCluster, tmp_path: Path) -> None:
    outcome = FrontEnd(tmp_path / "ray", *SWEEP, *on(ray_cluster)).end()
    assert outcome.code == 0, outcome.err
    assert [row["outcome"] for row in outcome.rows] == ["finished"] * 4
    assert "ssail, seed 1: epoch 3/3" in outcome.err
    assert numbers(tmp_path / "ray") == computed_locally(tmp_path / "local", SWEEP)


def test_what_ctrl_c_leaves_is_continued_by_the_same_command(
    ray_cluster: RayCluster, long: Numbers, tmp_path: Path
) -> None:
    front = FrontEnd(tmp_path, *LONG, *on(ray_cluster))
    front.wait_for("seed 0: epoch 12/120")
    front.process.send_signal(signal.SIGINT)
    outcome = front.end()
    assert outcome.code == 130, outcome.err
    assert outcome.rows[0]["outcome"] == "interrupted"
    store = Store.open(tmp_path / "results" / "ssmail.db")
    (row,) = store.runs(ids=[outcome.rows[0]["run"]])
    assert "stopped after epoch" in str(row.error)  # not just killed
    again = FrontEnd(tmp_path, *LONG, *on(ray_cluster)).end()
    assert again.code == 0, again.err
    assert numbers(tmp_path) == long


def test_the_cells_of_a_killed_node_are_computed_by_the_other(
    ray_cluster: RayCluster, long: Numbers, tmp_path: Path
) -> None:
    front = FrontEnd(tmp_path, *LONG, *on(ray_cluster))
    front.wait_for("seed 0: epoch 12/120")
    front.wait_for("seed 1: epoch 12/120")  # on the other node
    ray_cluster.kill(ray_cluster.nodes[1])
    outcome = front.end()
    assert outcome.code == 0, outcome.err
    assert [row["outcome"] for row in outcome.rows] == ["finished"] * 3
    assert numbers(tmp_path) == long
    store = Store.open(tmp_path / "results" / "ssmail.db")
    assert sorted(row.resumes for row in store.runs()) == [0, 0, 1]  # the kill hit one
