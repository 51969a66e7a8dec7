"""How every figure looks: one column wide, print-sized text, colours that colour-blind readers tell apart.

Colours are those of Okabe and Ito (2008); methods differ by line style too, so that a grey print stays readable.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLUMN_WIDTH = 3.4  # inches: one column of a two-column page
RESOLUTION = 300  # dots per inch of a PNG

REFERENCE = "#222222"
LANE = "#D4D4D4"
AGENTS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

# The style sheet. Fonts: embedded as text in a PDF, as paths in an SVG. The salt makes SVG ids repeatable.
SHEET: dict[Any, Any] = {
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.4,
    "legend.borderaxespad": 0.2,
    "legend.borderpad": 0.2,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "ssmail",
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}


class Stroke(NamedTuple):
    """How the lines of one group of runs are drawn."""

    colour: str
    line: str


METHODS = {
    "ssail": Stroke("#0072B2", "-"),
    "gail": Stroke("#D55E00", "--"),
    "wail": Stroke("#009E73", "-."),
    "dnri": Stroke("#CC79A7", "-"),
    "nri": Stroke("#E69F00", "--"),
    "bc": Stroke("#56B4E9", "-."),
}


def strokes(labels: Sequence[str]) -> dict[str, Stroke]:
    """A stroke for each label: a method's own, and for other labels those that are left, in order."""
    spare = [stroke for method, stroke in METHODS.items() if method not in labels] or list(METHODS.values())
    others = [label for label in labels if label not in METHODS]
    chosen = {label: spare[i % len(spare)] for i, label in enumerate(others)}
    return {label: METHODS.get(label) or chosen[label] for label in labels}


@contextmanager
def sheet() -> Iterator[None]:
    """Draw and save within the style sheet, on top of matplotlib's own defaults and not of the user's settings."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(SHEET)
        yield


def new_figure(height: float) -> Figure:
    """An empty Figure one column wide and `height` inches high, on the Agg canvas. Call it within `sheet()`."""
    figure = Figure(figsize=(COLUMN_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
