"""Computes cells (a spec and a seed each): `ssmail.execution.local` runs them in processes on this machine."""

from enum import StrEnum


class Resume(StrEnum):
    """What to do with a cell whose run is stored already.

    AUTO: skip a finished or diverged run, resume any other. REQUIRE: the same, but fail when there is nothing to
    resume. NEVER: start a new run and keep the old one.
    """

    AUTO = "auto"
    NEVER = "never"
    REQUIRE = "require"
