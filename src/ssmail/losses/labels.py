"""What the discriminator is trained to say of tau_alpha: label functions of alpha (sections 3.1.3 and A.2).

Eq. 3 itself fixes D(tau_G) = 0 and D(tau_E) = 1. A label function that says otherwise at alpha 0 or 1 would ask D for
two answers at one place; one that falls between them, or is above 0 behind the policy (alpha < 0), makes a reward that
leads the policy away from the expert. Both are refused, for built-in labels and for a user's own function alike, as far
as alpha is drawn from there. Beyond the expert (alpha > 1) a label may do anything: A.2 lets it fall to 0.
"""

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ssmail.config.experiments import function_folders
from ssmail.config.sections import SelfSupervisionSpec
from ssmail.config.shaping import Knots
from ssmail.config.user_functions import UserFunction, load, told
from ssmail.errors import InputError

LabelFunction = Callable[[Tensor], Tensor]

GRID = 501  # alphas of each range that a label function is checked at, beside 0, 1 and the knots
TOLERANCE = 1e-3  # of labels, in these checks


def identity(alpha: Tensor) -> Tensor:
    """The label of Eq. 3: alpha itself."""
    return alpha


def zero_above_one(alpha: Tensor) -> Tensor:
    """The label of A.2: alpha up to the expert, 0 beyond it."""
    return torch.where(alpha <= 1, alpha, torch.zeros_like(alpha))


def piecewise_linear(knots: Knots, alpha: Tensor) -> Tensor:
    """(B,) labels on the line through the knots (alpha, label), of rising alpha; before the first and after the last
    they stay as they are there.

    Two knots at one alpha are a jump: the first holds at that alpha and below, the second above it.
    """
    x, y = torch.tensor(knots, dtype=torch.float64, device=alpha.device).T.contiguous()
    at = alpha.double()
    right = torch.searchsorted(x, at).clamp(1, len(x) - 1)  # x[right - 1] < alpha <= x[right], but for the ends
    low, width = x[right - 1], x[right] - x[right - 1]
    fraction = torch.where(width > 0, (at - low) / width, (at > low).double()).clamp(0, 1)
    return torch.lerp(y[right - 1], y[right], fraction).to(alpha)


BUILT_IN: dict[str, LabelFunction] = {"identity": identity, "zero-above-one": zero_above_one}


def label_function(label: str | Knots) -> LabelFunction:
    """The function, alphas (B,) -> labels (B,), that a spec names. Raises InputError when it is a user's own function
    that cannot be loaded, or takes other than one argument.
    """
    if not isinstance(label, str):
        return lambda alpha: piecewise_linear(label, alpha)
    named = UserFunction.parse(label)
    return BUILT_IN[label] if named is None else _own(named)


def checked_label(spec: SelfSupervisionSpec) -> LabelFunction:
    """`label_function` of the spec, found fit for the alphas that are drawn (see above). Raises InputError, a sentence
    that names the function, when it raises, gives no tensor of finite labels of the shape (B,) of its alphas, depends
    on chance or on the rest of the batch, or has labels that are refused.
    """
    function = label_function(spec.label)
    alpha = _points(spec)
    labels = function(alpha)
    name = _name(spec.label)
    for part in (slice(None, None, 3), slice(0, 1)):
        if not torch.allclose(function(alpha[part]), labels[part], atol=1e-6):
            raise InputError(f"{name} depends on chance or on the other alphas of a batch; label each alpha by itself.")
    complaint = _complaint(alpha, labels)
    if complaint:
        raise InputError(f"{name} {complaint}.")
    return function


def _own(named: UserFunction) -> LabelFunction:
    """A user's own function. It gets a copy of the alphas on the CPU, and what it returns is checked at each call."""
    function = load(named, function_folders())
    name = _name(str(named))
    try:
        inspect.signature(function).bind(None)
    except TypeError as error:
        raise InputError(
            f"{name} cannot be called with one tensor of alphas ({told(error)}); let it take that."
        ) from None
    except ValueError:  # no signature to read
        pass

    def label(alpha: Tensor) -> Tensor:
        with torch.no_grad():
            try:
                given = function(alpha.detach().cpu().clone())
            except Exception as error:
                raise InputError(f"{name} raises {told(error)}, given {len(alpha)} alphas; correct it.") from error
        return _accepted(given, alpha, name)

    return label


def _accepted(given: Any, alpha: Tensor, name: str) -> Tensor:
    """What a user's own function returned, as labels (B,) beside their alphas."""
    if not isinstance(given, Tensor):
        raise InputError(f"{name} returns {type(given).__name__}, not a tensor; return a label for each of its alphas.")
    if given.shape != alpha.shape:
        shapes = f"{tuple(given.shape)} for alphas of shape {tuple(alpha.shape)}"
        raise InputError(f"{name} returns labels of shape {shapes}; return a label for each of them.")
    labels = given.detach().to(alpha)
    wrong = alpha[~labels.isfinite()]
    if len(wrong):
        raise InputError(f"{name} returns NaN or infinity for alpha {float(wrong[0]):.4g}; return finite labels.")
    return labels


def _points(spec: SelfSupervisionSpec) -> Tensor:
    """(P,) rising alphas from all that are drawn: a grid, and what is covered of 0, 1 and each knot, from above too."""
    pieces = spec.alpha_pieces
    special = torch.tensor([0.0, 1.0, *(() if isinstance(spec.label, str) else (knot[0] for knot in spec.label))])
    above = torch.nextafter(special, torch.tensor(torch.inf))
    grid = [torch.linspace(low, high, GRID if high > low else 1) for low, high, _ in pieces]
    special = torch.cat([special, above])
    covered = [special[(special >= low) & (special <= high)] for low, high, _ in pieces]
    return torch.tensor(sorted(set(torch.cat([*grid, *covered]).tolist())))


def _complaint(alpha: Tensor, labels: Tensor) -> str | None:
    """What is wrong with these labels of rising alphas, as the end of a sentence."""
    if not bool(labels.isfinite().all()):
        return f"is not finite at alpha {float(alpha[~labels.isfinite()][0]):.4g}; choose smaller numbers"
    for place, what in ((0, "tau_G"), (1, "tau_E")):
        for value in labels[alpha == place]:
            if abs(float(value) - place) > TOLERANCE:
                return f"is {float(value):.4g} at alpha {place}, where Eq. 3 asks D({what}) = {place}; make it {place}"
    behind = (alpha < 0) & (labels > TOLERANCE)
    if bool(behind.any()):
        where = f"is {float(labels[behind][-1]):.4g} at alpha {float(alpha[behind][-1]):.4g}"
        return f"{where}, which leads the policy backwards; let it be 0 or less below alpha 0"
    between = (alpha >= 0) & (alpha <= 1)
    alpha, labels = alpha[between], labels[between]
    falls = labels[1:] < labels.cummax(dim=0).values[:-1] - TOLERANCE if len(labels) else labels.bool()
    if bool(falls.any()):
        where = f"falls to {float(labels[1:][falls][0]):.4g} at alpha {float(alpha[1:][falls][0]):.4g}"
        return f"{where}, which leads the policy away from the expert; let it rise from alpha 0 to 1"
    return None


def _name(label: str | Knots) -> str:
    """How a sentence begins."""
    own = UserFunction.parse(label)
    what = f"the function {own}" if own else str(label) if isinstance(label, str) else "the line through the knots"
    return f"self_supervision.label: {what}"
