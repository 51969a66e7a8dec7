"""How many jobs per second each launcher starts and ends, beside a plain pool of processes, all in one run.

A job computes no cell: it opens the database and returns. So this is what a launcher adds to the work itself. For
--launcher local a cell is claimed in the database, and its process only says that it has finished. SLURM and Ray are
started for this on this machine with two CPUs; what is not installed is left out.

python benchmarks/launchers.py [JOBS [JOBS OF SLURM]]
"""

import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests, which can start clusters

import pytest

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.execution.cells import Cell
from ssmail.execution.launchers import Launcher, compute, job_text
from ssmail.execution.local import run_cells
from ssmail.store import Store

CPUS = 2
NO_OP = """
import json, sys
job = json.loads(sys.stdin.readline())
for seed, (run_id, _) in zip(job["seeds"], job["claims"]):
    event = {"kind": "finished", "run_id": run_id, "epoch": 0, "epochs": 0, "metrics": {}, "message": ""}
    print(json.dumps({"seed": seed, **event}), flush=True)
"""


def plain_pool(jobs: list[str]) -> None:
    """Call `compute` in a pool of processes, which are not started anew for each job."""
    with ProcessPoolExecutor(CPUS) as pool:
        assert list(pool.map(compute, jobs)) == [""] * len(jobs)


def local(count: int, folder: Path) -> None:
    spec = build_spec("copy-last", "yjunction", "smoke")
    cells = [Cell(spec, seed) for seed in range(count)]
    url = Store.open(folder / "local.db").url
    worker = (sys.executable, "-S", "-c", NO_OP)
    events = run_cells(cells, store_url=url, on_event=lambda _: None, jobs=CPUS, worker=worker)
    assert {event.kind for event in events} == {"finished"}


def launched(launcher: Launcher, jobs: list[str]) -> None:
    waiting = set(launcher.submit(jobs))
    while waiting:
        for ended in launcher.poll():
            assert ended.result == "", ended
            waiting.remove(ended.job)
        time.sleep(0.05)


def on_ray(jobs: list[str]) -> float:
    from tests.execution.ray_cluster import RayCluster

    cluster = RayCluster(CPUS)
    try:
        from ssmail.execution.ray_launcher import RayLauncher

        launcher = RayLauncher({"address": cluster.address}, 1)
        launched(launcher, jobs[:CPUS])  # the first tasks start processes that the others use
        taken = seconds(lambda: launched(launcher, jobs))
        launcher.close()
        return taken
    finally:
        cluster.close()


def on_slurm(jobs: list[str], folder: Path) -> float:
    from tests.execution.slurm_cluster import Cluster

    cluster = Cluster()
    try:
        pytest.importorskip("submitit")
        from ssmail.execution.slurm_launcher import SlurmLauncher

        with pytest.MonkeyPatch.context() as patch:
            for name, value in cluster.environment.items():
                patch.setenv(name, value)
            launcher = SlurmLauncher({"array_parallelism": str(CPUS)}, folder / "slurm", 1)
            return seconds(lambda: launched(launcher, jobs))
    finally:
        cluster.close()


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def report(count: int, of_slurm: int) -> None:
    """Print a line for each launcher."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jobs = [job_text([], Store.open(folder / "ssmail.db"), "cpu", 1, 1)] * count
        for launcher, number, measure in (
            ("a plain process pool", count, lambda: seconds(lambda: plain_pool(jobs))),
            ("local", count, lambda: seconds(lambda: local(count, folder))),
            ("ray", count, lambda: on_ray(jobs)),
            ("slurm", of_slurm, lambda: on_slurm(jobs[:of_slurm], folder)),
        ):
            try:
                taken = measure()
                print(f"{launcher:<22}{number:6} in {taken:7.1f} s {number / taken:9.2f} per second", flush=True)
            except (pytest.skip.Exception, InputError) as error:
                print(f"{launcher:<22}left out: {error}", flush=True)


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:]]
    report(*([*numbers, *(1000, 100)[len(numbers) :]]))
