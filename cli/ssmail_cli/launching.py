"""--launcher and --launcher-set: where the processes of a sweep run."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError, shortened
from ssmail.execution import LauncherName, Resume
from ssmail_cli.options import pick_device
from ssmail_cli.progress import Report

if TYPE_CHECKING:
    from ssmail.execution.cells import Cell, Event
    from ssmail.store import Store

Name = Annotated[
    LauncherName,
    typer.Option(
        "--launcher",
        help="Compute on this machine, in an array of SLURM jobs, or in tasks of a Ray cluster. All nodes need the "
        "database: give --db a PostgreSQL URL; an SQLite file on a network file system may be damaged.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--launcher-set",
        metavar="KEY=VALUE",
        help="Settings of --launcher slurm (partition=gpu,time=120 in minutes, cpus, gpus, mem=4G, array_parallelism "
        "and others of sbatch) or ray (address, cpus, gpus, memory=4G); of both: cells=N, how many runs a job "
        "computes. Commas separate several; repeatable.",
    ),
]


@dataclass(frozen=True)
class Launch:
    """Where and how a sweep is computed: --launcher, its settings, --jobs, --resume, --device and --per-device."""

    jobs: int = 1
    resume: Resume = Resume.AUTO
    device: str = "cpu"
    per_device: int = 1
    launcher: LauncherName = LauncherName.LOCAL
    settings: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        jobs: int,
        resume: Resume,
        device: str,
        per_device: int,
        launcher: LauncherName,
        texts: Sequence[str] | None,
    ) -> "Launch":
        """Return what the options say. Raises InputError where they do not fit each other, or this machine."""
        settings = parse_settings(texts or ())
        if launcher is LauncherName.LOCAL:
            if settings:
                raise InputError("--launcher-set is for --launcher slurm and --launcher ray; leave it out.")
            return cls(jobs, resume, pick_device(device), per_device)
        if resume is Resume.NEVER:
            raise InputError(
                f"--launcher {launcher} is for --resume auto or require, not never, because a job that is requeued "
                "resumes its runs."
            )
        from ssmail.execution.launched_sweep import check_settings

        check_settings(launcher, settings)
        return cls(jobs, resume, device, per_device, launcher, settings)  # the device is that of a node

    def compute(self, store: "Store", cells: "Sequence[Cell]", report: Report) -> "list[Event]":
        """Compute the cells, and return their final events in the same order."""
        artifacts = store.storage.place if store.storage else None
        if self.launcher is LauncherName.LOCAL:
            from ssmail.execution.local import run_cells

            return run_cells(
                cells,
                store_url=store.url,
                jobs=self.jobs,
                artifacts=artifacts,
                device=self.device,
                per_device=self.per_device,
                resume=self.resume,
                on_event=report,
            )
        from ssmail.execution.launched_sweep import launch_cells, open_launcher

        launcher, grouping = open_launcher(self.launcher, self.settings, store, self.jobs)
        try:
            return launch_cells(
                cells,
                store_url=store.url,
                launcher=launcher,
                on_event=report,
                grouping=grouping,
                artifacts=artifacts,
                device=self.device,
                per_device=self.per_device,
                resume=self.resume,
            )
        finally:
            launcher.close()


def parse_settings(texts: Sequence[str]) -> dict[str, str]:
    """["partition=gpu,time=120"] -> {"partition": "gpu", "time": "120"}. Raises InputError for anything else."""
    settings: dict[str, str] = {}
    for part in (part.strip() for text in texts for part in text.split(",")):
        key, equals, value = part.partition("=")
        if not equals or not key.strip() or not value.strip() or not value.isprintable():
            raise InputError(
                f"--launcher-set takes KEY=VALUE with commas between several, such as partition=gpu,time=120, not "
                f"'{shortened(part, 60)}'."
            )
        settings[key.strip()] = value.strip()
    return settings
