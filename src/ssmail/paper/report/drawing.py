"""Draw and save a figure of the paper, and keep what the report shows of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from ssmail.evaluation.statistics import Statistic
from ssmail.paper.results import FIGURES
from ssmail.plots.provenance import Provenance
from ssmail.store import Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EMBEDDED_RESOLUTION = 250  # dots per inch of a picture that is only in the report


@dataclass(frozen=True)
class Drawn:
    """A figure with its `files` (the CSV last), `provenance` and `notes`; or else why it `lacks` all of these."""

    name: str
    files: tuple[Path, ...] = ()
    figure: "Figure | None" = None
    provenance: Provenance | None = None
    notes: tuple[str, ...] = ()
    lacks: str = ""

    @property
    def alias(self) -> str:
        """Its name in words, such as "stability"."""
        return FIGURES[self.name].alias

    @property
    def summary(self) -> str:
        """One line on what it shows."""
        return FIGURES[self.name].summary

    @cached_property
    def image(self) -> bytes:
        """The saved PNG, or one made for the report; empty for a figure that was not drawn."""
        from ssmail.plots import style

        for path in self.files:
            if path.suffix == ".png":
                return path.read_bytes()
        picture = BytesIO()
        if self.figure is not None:
            with style.sheet():
                self.figure.savefig(picture, format="png", dpi=EMBEDDED_RESOLUTION)
        return picture.getvalue()


def draw(
    name: str,
    store: Store,
    runs: Sequence[str] | None,
    out: Path,
    formats: Sequence[str],
    *,
    profile: str | None = None,
    statistic: Statistic | None = None,
) -> Drawn:
    """Collect, draw and save the figure `name` ("fig4") of these runs (ids), or of its default choice.

    Raises what FigureModule.collect and save_figure raise.
    """
    from ssmail.plots.saving import save_figure

    module = FIGURES[name]
    record = module.collect(store, runs, profile=profile, statistic=statistic)
    figure = module.draw(record)
    files = save_figure(module.stem, record, figure, out, formats)
    return Drawn(module.name, tuple(files), figure, record.provenance, record.notes)
