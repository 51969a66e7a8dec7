"""A synthetic database, in which C3 is true and one run of gail diverged, and the report of it."""

from pathlib import Path
from typing import NamedTuple

import pytest

from ssmail.config.experiments import ablation_specs, build_spec
from ssmail.config.spec import RunSpec
from ssmail.paper.judgement import judge
from ssmail.paper.report.contents import Report, gather
from ssmail.paper.report.drawing import Drawn, draw
from ssmail.paper.report.pages import write
from ssmail.store import RunState, Store
from tests.paper.handmade_arrays import arrays

ERRORS = {
    0.0: (0.020, 0.024, 0.028, 0.032, 0.036),
    0.15: (0.0020, 0.0021, 0.0022, 0.0023, 0.0024),
    1.0: (0.020, 0.025, 0.030, 0.035, 0.040),
}
UNFINISHED = "wail, seed 3 failed: <b>out of memory</b> | killed"
COMMAND = "ssmail reproduce --profile smoke --seeds 0-4"


class Written(NamedTuple):
    """The report and its files."""

    report: Report
    html: str
    markdown: str
    folder: Path


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The report of a store with the runs of figure 4 and of three values of beta; figure 7 is not drawn."""
    folder = tmp_path_factory.mktemp("report")
    store = Store.open(folder / "ssmail.db")
    for method in ("ssail", "gail", "wail"):
        for seed in range(3):
            add(
                store, build_spec(method, "yjunction", "smoke"), seed, 0.001 * (1 + seed), (method, seed) == ("gail", 1)
            )
    for value, spec in ablation_specs("beta", "smoke", values=list(ERRORS)).items():
        for seed, error in enumerate(ERRORS[value]):
            add(store, spec, seed, error)
    drawn = draw("fig4", store, None, folder / "figures", ["png"])
    figures = [drawn, Drawn("fig7", lacks="there is no data/mocap.npz.")]
    report = gather(store, figures, judge(store, "smoke"), COMMAND, [UNFINISHED])
    markdown, html = write(report, folder)
    store.close()
    return Written(report, html.read_text(), markdown.read_text(), folder)


def add(store: Store, spec: RunSpec, seed: int, error: float, diverged: bool = False) -> None:
    writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu", repeat=True)
    for epoch in (1, 2, 3):
        writer.epoch(epoch, {"train/mode_mse": 2 * error / epoch, "validation/mode_mse": error})
    if not diverged:
        writer.arrays(arrays(0.0))
        errors = {"test/mode_mse": error, "test_last/mode_mse": error, "test_constant_velocity/mode_mse": 0.045}
        writer.final(3, errors | {"test/on_lane": 0.9})
    writer.finish(RunState.DIVERGED if diverged else RunState.FINISHED)
