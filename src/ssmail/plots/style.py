"""How every figure looks: one column wide (or both), print-sized text, colours that colour-blind readers tell apart.

Colours are those of Okabe and Ito (2008); methods differ by line style too, so that a grey print stays readable.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from ssmail.data.trajectories import Floats
from ssmail.errors import printable, shortened

COLUMN_WIDTH = 3.4  # inches: one column of a two-column page
PAGE_WIDTH = 7.0  # inches: both columns
RESOLUTION = 300  # dots per inch of a PNG

REFERENCE = "#222222"
LANE = "#D4D4D4"
STRIPE = "#F2F2F2"
REACH = 3.0
_LABEL = 120  # characters
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
    "legend.title_fontsize": 7,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "ssmail",
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}


class Stroke(NamedTuple):
    """Line style of one group of runs."""

    colour: str
    line: str


LINES = ("-", "--", "-.")
METHODS = {
    "ssail": Stroke("#0072B2", "-"),
    "gail": Stroke("#D55E00", "--"),
    "wail": Stroke("#009E73", "-."),
    "dnri": Stroke("#CC79A7", "-"),
    "nri": Stroke("#E69F00", "--"),
    "bc": Stroke("#56B4E9", "-."),
}


def strokes(labels: Sequence[str]) -> dict[str, Stroke]:
    """Return a stroke for each label: a method's own, and the remaining strokes, in order, for other labels.

    Where they do not suffice, the other labels go from dark to light, in viridis, which colour-blind readers can order.
    """
    spare = [stroke for method, stroke in METHODS.items() if method not in labels]
    others = [label for label in labels if label not in METHODS]
    if len(others) > len(spare):
        shades = matplotlib.colormaps["viridis"](np.linspace(0, 0.92, len(others)))
        spare = [Stroke(to_hex(shade), LINES[i % len(LINES)]) for i, shade in enumerate(shades)]
    chosen = dict(zip(others, spare, strict=False))
    return {label: METHODS.get(label) or chosen[label] for label in labels}


@contextmanager
def sheet() -> Iterator[None]:
    """Draw and save within the style sheet, on top of matplotlib's own defaults and not of the user's settings.

    Letters that the font lacks are drawn as boxes, without a warning for each.
    """
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(SHEET)
        yield


def new_figure(height: float, width: float = COLUMN_WIDTH) -> Figure:
    """Return an empty Figure of this size in inches, on the Agg canvas. Call it within `sheet()`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def literal(text: str) -> str:
    """Return a stored text as matplotlib has to get it, to show it as it is, on one line of bearable length.

    Between two dollars matplotlib would read mathematics; a label that begins with _ it would leave out of the legend.
    """
    shown = shortened(printable(text), _LABEL).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def log_axis(axes: Axes, limits: tuple[float, float]) -> None:
    """Make the y axis logarithmic with these limits. A range of few decades gets a fine grid, and plain numbers."""
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    narrow = limits[1] < 1e2 * limits[0]
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if narrow else (1,), numticks=8))
    if narrow:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    if limits[1] < 1e3 * limits[0]:
        axes.grid(which="minor", axis="y", lw=0.2)
    else:
        axes.yaxis.set_minor_locator(NullLocator())


def log_limits(values: Floats, ceiling: float = np.inf) -> tuple[float, float]:
    """Return limits of at least a decade for the positive finite `values`, at most `ceiling`."""
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return 1e-3, 1.0
    top = float(min(values.max() * 1.5, ceiling))
    return min(float(values.min()) / 1.5, top / 10), top


def cut_low(low: Floats, lowest: Floats) -> Floats:
    """Return the lower ends of spreads for a logarithmic scale: at most a factor REACH below the lowest run.

    It would draw an end at or below 0 infinitely deep. NaN and -inf, an end that there is not, stay.
    """
    return np.where(np.isfinite(low), np.maximum(low, lowest / REACH), low)


def epoch_axis(axes: Axes) -> None:
    """Make the x axis one of whole epochs."""
    axes.set_xlabel("epoch")
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))


def step_axis(axes: Axes, steps: int) -> None:
    """Make the x axis one of predicted steps, with ticks at the first, at the last and at the quarters between them."""
    axes.set_xlabel("predicted step")
    axes.xaxis.set_major_locator(FixedLocator(sorted({1, *(round(steps * part / 4) or 1 for part in (1, 2, 3, 4))})))


def draw_reference(axes: Axes, error: float) -> Line2D:
    """Draw the dotted line of constant velocity, and return it for the legend."""
    return axes.axhline(
        error, color=REFERENCE, lw=1.0, ls=":", label="constant velocity (test)", gid="constant-velocity"
    )


def draw_cross(axes: Axes, x: npt.ArrayLike, y: npt.ArrayLike, colour: str) -> Line2D:
    """Draw a cross for each run that diverged; it is not clipped at the edge."""
    (crosses,) = axes.plot(x, y, "x", color=colour, ms=4.5, mew=1.1, clip_on=False, zorder=5)
    return crosses
