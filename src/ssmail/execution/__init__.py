"""Computes cells (a spec and a seed each): `ssmail.execution.local` runs them in processes on this machine.

`ssmail.execution.launched_sweep` lets the jobs of a cluster compute them.
"""

from enum import StrEnum


class Resume(StrEnum):
    """What to do with a cell whose run is stored already.

    AUTO: skip a finished or diverged run, resume any other. REQUIRE: the same, but fail when there is nothing to
    resume. NEVER: start a new run and keep the old one.
    """

    AUTO = "auto"
    NEVER = "never"
    REQUIRE = "require"


class LauncherName(StrEnum):
    """Where the processes that compute cells run: on this machine, as jobs of SLURM, or as tasks of a Ray cluster."""

    LOCAL = "local"
    SLURM = "slurm"
    RAY = "ray"
