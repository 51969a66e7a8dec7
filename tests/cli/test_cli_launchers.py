"""`--launcher` and `--launcher-set`."""

import io
import shlex
import socket
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

from ssmail import execution
from ssmail.config.experiments import build_spec
from ssmail.execution import LauncherName, launched_sweep, launchers, local
from ssmail.execution.cells import Cell, Event
from ssmail.execution.launchers import Ended, compute
from ssmail_cli import progress
from ssmail_cli.launching import parse_settings
from tests.cli.command_line import CommandLine, FakeTraining
from tests.execution import launched as tested

COPY = ("train", "copy-last", "--profile", "smoke", "--seeds", "0-1", "--device", "cpu")
SLURM, RAY = ("--launcher", "slurm"), ("--launcher", "ray")


class Here:
    """A launcher whose jobs run when they are polled."""

    def __init__(self) -> None:
        self.jobs: list[str] = []
        self.closed = False

    def submit(self, jobs: Sequence[str]) -> list[str]:
        self.jobs += jobs
        return [f"job {number}" for number in range(len(jobs))]

    def poll(self) -> list[Ended]:
        jobs, self.jobs = self.jobs, []
        with redirect_stdout(io.StringIO()):  # which is the log of a job
            return [Ended(f"job {number}", compute(job)) for number, job in enumerate(jobs)]

    def cancel(self) -> None:
        raise AssertionError

    def close(self) -> None:
        self.closed = True


def test_a_launched_sweep_prints_what_a_local_one_does(
    cli: CommandLine, db: Path, tmp_path: Path, fake: FakeTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake()
    monkeypatch.setattr(launchers, "run_cells", local.run_cells)
    opened: list[Any] = []
    here = Here()

    def open_launcher(name: str, settings: dict[str, str], _: Any, jobs: int) -> Any:
        opened.append((name, settings, jobs))
        return here, launched_sweep.Grouping(2, jobs)

    monkeypatch.setattr(launched_sweep, "check_settings", lambda *_: None)
    monkeypatch.setattr(launched_sweep, "open_launcher", open_launcher)
    settings = ("--launcher-set", "partition=gpu, time=120", "--launcher-set", "cells=2", "--jobs", 2)
    launched = cli(*COPY, *SLURM, *settings, "--db", db)
    assert launched.code == 0, launched.err
    assert opened == [("slurm", {"partition": "gpu", "time": "120", "cells": "2"}, 2)]
    assert here.closed
    plain = cli(*COPY, "--db", tmp_path / "local.db")
    own = ("run", "wall_seconds")
    rows = [[{key: row[key] for key in row if key not in own} for row in each.rows] for each in (launched, plain)]
    assert rows[0] == rows[1]
    assert [row["outcome"] for row in rows[0]] == ["finished", "finished"]
    again = cli(*COPY, *SLURM, "--db", db)
    assert [row["outcome"] for row in again.rows] == ["skipped", "skipped"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--launcher-set", "partition=gpu"), "--launcher-set is for --launcher slurm and --launcher ray; leave it"),
        ((*SLURM, "--launcher-set", "gpu"), "--launcher-set takes KEY=VALUE with commas between several"),
        ((*SLURM, "--launcher-set", "time=1,"), "--launcher-set takes KEY=VALUE with commas between several"),
        ((*RAY, "--launcher-set", "cpus="), "--launcher-set takes KEY=VALUE with commas between several"),
        ((*SLURM, "--resume", "never"), "--launcher slurm is for --resume auto or require, not never"),
        ((*SLURM, "--enqueue"), "--enqueue leaves the runs to `ssmail worker`, --launcher slurm does not"),
        ((*SLURM, "--launcher-set", "cells=0"), "--launcher-set cells takes a whole number of at least 1, not '0'"),
        (("--launcher", "kubernetes"), "kubernetes"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(
    cli: CommandLine, db: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    assert sentence in cli(*COPY, *arguments, "--db", db).sentence
    assert not db.exists()


@pytest.mark.parametrize(
    ("package", "arguments", "sentence"),
    [
        ("submitit", (*SLURM, "--launcher-set", "partitio=gpu"), "slurm 'partitio'; did you mean partition?"),
        ("submitit", (*SLURM, "--launcher-set", "time=2:00"), "time takes a whole number of at least 1, not '2:00'"),
        ("ray", (*RAY, "--launcher-set", "partition=gpu"), "unknown setting of --launcher ray 'partition'; choose"),
        ("ray", (*RAY, "--launcher-set", "cpus=-1"), "cpus takes a number such as 1 or 0.5, not '-1'"),
        ("ray", (*RAY, "--launcher-set", "memory=much"), "memory takes a number of bytes such as 4G, not 'much'"),
    ],
)
def test_a_wrong_setting_is_named(
    cli: CommandLine, db: Path, package: str, arguments: tuple[str, ...], sentence: str
) -> None:
    pytest.importorskip(package, reason=f"{package}, of an extra, is not installed")
    assert sentence in cli(*COPY, *arguments, "--db", db).sentence
    assert not db.exists()


@pytest.mark.parametrize("setting", [True, False])
def test_a_cluster_that_is_not_there_is_one_sentence_at_once(
    cli: CommandLine, db: Path, monkeypatch: pytest.MonkeyPatch, setting: bool
) -> None:
    """Ray itself would try for minutes."""
    pytest.importorskip("ray", reason="ray, of an extra, is not installed")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{closed.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        outcome = cli(*COPY, *RAY, *(("--launcher-set", f"address={address}") if setting else ()), "--db", db)
    assert outcome.code == 2
    announced, said = outcome.err.splitlines()
    assert announced.startswith("2 runs: ")
    assert said.startswith(f"ssmail: --launcher ray cannot reach a Ray cluster at address={address} (nothing answers ")


@pytest.mark.parametrize(("launcher", "package"), [("slurm", "submitit"), ("ray", "ray")])
def test_a_launcher_without_its_package_says_how_to_install_it(
    cli: CommandLine, db: Path, fake: FakeTraining, monkeypatch: pytest.MonkeyPatch, launcher: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"ssmail.execution.{launcher}_launcher", raising=False)
    monkeypatch.delattr(execution, f"{launcher}_launcher", raising=False)
    said = cli(*COPY, "--launcher", launcher, "--db", db).sentence
    assert said == f"the package {package} is not installed; run `pip install 'ssmail[{launcher}]'`"
    fake()
    assert cli(*COPY, "--db", db).code == 0  # nobody else needs it


def test_the_commands_of_the_documentation_are_those_of_the_slow_tests() -> None:
    """With the settings that launch a real sweep in tests/execution/test_slurm.py and test_ray.py."""
    text = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text()
    launched = [line for line in text.splitlines() if line.startswith("ssmail train") and "--launcher " in line]
    assert len(launched) == 3
    for line in launched:
        words = shlex.split(line)
        named = words[words.index("--launcher") + 1]
        settings = parse_settings([words[words.index("--launcher-set") + 1]])
        pytest.importorskip("submitit" if named == "slurm" else "ray", reason="an extra is not installed")
        launched_sweep.check_settings(LauncherName(named), settings)
        assert " ".join(tested.SLURM if named == "slurm" else RAY) in line
        assert {"slurm": {"partition", "time"}, "ray": {"address", "cpus"}}[named] <= settings.keys()


def test_a_run_that_is_resumed_again_counts_its_old_epochs_once() -> None:
    """As after a job was requeued twice, in the line of all runs together."""
    cell = Cell(build_spec("bc", "yjunction", "smoke", ["training.epochs=9"]), 0)
    shown = Progress(disable=True)
    report = progress._RunningRuns(shown, {cell: "seed 0"})
    for kind, epoch in (("loading", 0), ("resumed", 2), ("epoch", 3), ("resumed", 3), ("epoch", 4), ("resumed", 4)):
        report(Event(kind, cell, "a" * 32, epoch, 9))  # type: ignore[arg-type]
    assert (shown.tasks[0].completed, shown.tasks[0].total) == (2, 7)
