"""Label functions of alpha: the discriminator's target for tau_alpha (sections 3.1.3 and A.2), and their checks.

Eq. 3 fixes D(tau_G) = 0 and D(tau_E) = 1. A label function with another value at alpha 0 or 1 asks D for two answers at
one point. One that falls between 0 and 1, or is positive behind the policy (alpha < 0), makes a reward that leads the
policy away from the expert. Both are rejected, for built-in labels and user functions alike, wherever alpha is drawn.
Beyond the expert (alpha > 1) any label is allowed: in A.2 it drops to 0.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from ssmail.config.sections import SelfSupervisionSpec
from ssmail.config.shaping import Knots
from ssmail.errors import InputError

LabelFunction = Callable[[Tensor], Tensor]

GRID = 501  # alphas checked in each range, in addition to 0, 1 and the knots
TOLERANCE = 1e-3  # in units of the label


def identity(alpha: Tensor) -> Tensor:
    """The label of Eq. 3: alpha itself."""
    return alpha


def zero_above_one(alpha: Tensor) -> Tensor:
    """The label of A.2: alpha up to the expert, 0 beyond it."""
    return torch.where(alpha <= 1, alpha, torch.zeros_like(alpha))


def piecewise_linear(knots: Knots, alpha: Tensor) -> Tensor:
    """Interpolate linearly between knots (alpha, label) of rising alpha; constant before the first and after the last.

    Two knots at one alpha are a jump: the first holds at and below that alpha, the second above it. Returns (B,) labels
    for (B,) alphas.
    """
    x, y = torch.tensor(knots, dtype=torch.float64, device=alpha.device).T.contiguous()
    at = alpha.double()
    right = torch.searchsorted(x, at).clamp(1, len(x) - 1)  # x[right - 1] < alpha <= x[right], except at the ends
    low, width = x[right - 1], x[right] - x[right - 1]
    fraction = torch.where(width > 0, (at - low) / width, (at > low).double()).clamp(0, 1)
    return torch.lerp(y[right - 1], y[right], fraction).to(alpha)


BUILT_IN: dict[str, LabelFunction] = {"identity": identity, "zero-above-one": zero_above_one}


def label_function(label: str | Knots, user_function: LabelFunction | None = None) -> LabelFunction:
    """Return the function from alphas (B,) to labels (B,): the user's own, a built-in one by name, or that of knots."""
    if user_function is not None:
        return user_function
    return BUILT_IN[label] if isinstance(label, str) else lambda alpha: piecewise_linear(label, alpha)


def checked_label(spec: SelfSupervisionSpec, user_function: LabelFunction | None) -> LabelFunction:
    """Return `label_function` of the spec after checking it for all alphas that the spec can draw.

    Raises InputError, one sentence that names the function, if it depends on chance or on the rest of the batch, or has
    labels that are not finite or are rejected (see the module's docstring).
    """
    function = label_function(spec.label, user_function)
    name = "the line through the knots"
    if isinstance(spec.label, str):
        name = f"the function {spec.label.partition('@')[0]}" if user_function else spec.label
    alpha = _alphas_to_check(spec)
    labels = function(alpha)
    problem = _problem(alpha, labels)
    for part in (slice(None, None, 3), slice(0, 1)):
        if not torch.allclose(function(alpha[part]), labels[part], atol=1e-6):
            problem = "depends on chance or on the other alphas of a batch; label each alpha by itself"
    if problem:
        raise InputError(f"self_supervision.label: {name} {problem}.")
    return function


def _alphas_to_check(spec: SelfSupervisionSpec) -> Tensor:
    """Return rising alphas (P,): a grid of every range, and 0, 1 and the knots where drawn, each also from above."""
    pieces = spec.alpha_pieces
    special = torch.tensor([0.0, 1.0, *(() if isinstance(spec.label, str) else (knot[0] for knot in spec.label))])
    special = torch.cat([special, torch.nextafter(special, torch.tensor(torch.inf))])
    grid = [torch.linspace(low, high, GRID if high > low else 1) for low, high, _ in pieces]
    covered = [special[(special >= low) & (special <= high)] for low, high, _ in pieces]
    return torch.tensor(sorted(set(torch.cat([*grid, *covered]).tolist())))


def _problem(alpha: Tensor, labels: Tensor) -> str | None:
    """Return what is wrong with the labels (P,) of rising alphas (P,), as the end of a sentence."""
    if not bool(labels.isfinite().all()):
        return f"is not finite at alpha {float(alpha[~labels.isfinite()][0]):.4g}; choose smaller numbers"
    # the ends: Eq. 3
    for end, trajectory in ((0, "tau_G"), (1, "tau_E")):
        for value in labels[alpha == end]:
            if abs(float(value) - end) > TOLERANCE:
                return f"is {float(value):.4g} at alpha {end}, where Eq. 3 asks D({trajectory}) = {end}; make it {end}"
    # behind the policy: no reward for moving backwards
    behind = (alpha < 0) & (labels > TOLERANCE)
    if bool(behind.any()):
        where = f"is {float(labels[behind][-1]):.4g} at alpha {float(alpha[behind][-1]):.4g}"
        return f"{where}, which leads the policy backwards; let it be 0 or less below alpha 0"
    # between policy and expert: never below an earlier label
    between = (alpha >= 0) & (alpha <= 1)
    alpha, labels = alpha[between], labels[between]
    falls = labels < torch.cummax(labels, dim=0).values - TOLERANCE
    if bool(falls.any()):
        where = f"falls to {float(labels[falls][0]):.4g} at alpha {float(alpha[falls][0]):.4g}"
        return f"{where}, which leads the policy away from the expert; let it rise from alpha 0 to 1"
    return None
