"""C4, noise (section 4.6, Figure 7): DNRI's error and its spread grow with the horizon, SS-AIL's grow ever more slowly.

All curves are over predicted steps of the test windows of Noisy Mocap, with noise on what is read. The paper does not
say over what its standard deviation is taken; here it is over test windows, so that each seed has its own.
"""

from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.curve_numbers import Floats, slope
from ssmail.paper.statements import smaller, typical

CLAIM = Claim(
    name="C4",
    alias="noise",
    sentence="With noisy input DNRI deviates further the longer it predicts, and its standard deviation grows too; "
    "SS-AIL's error does not grow linearly, and its slope falls.",
    section="4.6",
    figure="fig7",
)

GROWTH = (
    "slope of the least-squares line through test_noisy/mse over all predicted steps, squared scaled units per step"
)
SPREADING = "likewise of test_noisy/mse_spread, the standard deviation over test windows"
LATE = "slope of test_noisy/mse over the last half of the predicted steps, squared scaled units per step"
BENDING = "slope of test_noisy/mse over the last half of the predicted steps minus that over the first half"


def late_slope(errors: Floats) -> float:
    """See LATE; of (T,) errors."""
    return slope(errors[len(errors) // 2 :])


def bending(errors: Floats) -> float:
    """See BENDING; of (T,) errors. Negative: grows ever more slowly."""
    first = slope(errors[: len(errors) // 2])
    return late_slope(errors) if first == float("inf") else late_slope(errors) - first


def decide(growth: Sample, spreading: Sample, bent: Sample, late: Sample, late_dnri: Sample) -> tuple[Part, ...]:
    """From growth and spreading of dnri, the bending and the late slope of ssail, and the late slope of dnri."""
    return (
        typical("dnri's error grows with the horizon", GROWTH, growth, "above", 0.0),
        typical("dnri's spread grows with the horizon", SPREADING, spreading, "above", 0.0),
        typical("ssail's slope falls with the horizon", BENDING, bent, "below", 0.0),
        smaller("ssail's error grows more slowly than dnri's at long horizons", LATE, late, late_dnri),
    )
