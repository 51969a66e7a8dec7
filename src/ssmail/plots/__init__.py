"""Drawing stored runs: what every figure's record offers.

Importing this package imports neither matplotlib nor pandas.
"""

from typing import TYPE_CHECKING, Protocol

from ssmail.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from ssmail.plots.provenance import Provenance

__all__ = ["FigureRecord", "NoRuns"]


class NoRuns(InputError):  # noqa: N818 - named for what is the case, as its siblings are
    """The store holds no run that the figure can be drawn from; the message gives the command that produces one."""


class FigureRecord(Protocol):
    """What every figure's frozen record offers."""

    @property
    def provenance(self) -> "Provenance":
        """The runs that the figure is drawn from, the names of their curves, and the options of `collect`."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the reader: which runs were chosen, and what was left out."""
        ...

    @property
    def caption(self) -> str:
        """What the figure shows, in a few sentences that a paper could use."""
        ...

    def table(self) -> "pd.DataFrame":
        """Exactly what is shown, one row for each point."""
        ...
