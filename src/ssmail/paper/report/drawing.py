"""One figure, saved to its files, with what the report shows of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from ssmail.evaluation.statistics import Statistic
from ssmail.paper.results import FIGURES, save
from ssmail.plots import provenance
from ssmail.plots.provenance import Provenance
from ssmail.store import Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 250  # dots per inch of a picture that is in the report alone


@dataclass(frozen=True)
class Drawn:
    """A figure: its `files` (the CSV last), `provenance` and `notes`, or why it `lacks` all this."""

    name: str
    files: tuple[Path, ...] = ()
    figure: "Figure | None" = None
    provenance: Provenance | None = None
    notes: tuple[str, ...] = ()
    lacks: str = ""

    @property
    def alias(self) -> str:
        """What else it is called."""
        return FIGURES[self.name].alias

    @property
    def summary(self) -> str:
        """What it shows, in a line."""
        return FIGURES[self.name].summary

    @cached_property
    def image(self) -> bytes:
        """The PNG that was saved; without one, another; nothing of a figure that is not drawn."""
        from ssmail.plots import style

        for path in self.files:
            if path.suffix == ".png":
                return path.read_bytes()
        picture = BytesIO()
        if self.figure is not None:
            with style.sheet():
                self.figure.savefig(picture, format="png", dpi=SHOWN)
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
    """Collect, draw and save the figure `name` ("fig4") of these runs (ids), or of those that it chooses by itself.

    Raises what the figure's `collect` and `ssmail.paper.results.save` raise.
    """
    module = FIGURES[name]
    record = module.collect(store, runs, profile=profile, statistic=statistic)
    figure = module.draw(record)
    files = save(name, record, figure, out, formats)
    return Drawn(module.name, tuple(files), figure, provenance.read(files[0]), record.notes)
