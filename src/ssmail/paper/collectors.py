"""One collector for each claim: from the runs of its figure to the parts of its verdict (docs/claims.md).

What a diverged run counts as is written at each sample: WORST of an error, LEAST of what should be great; of a group
that the claim speaks ill of, and where no error is measured, whatever speaks against the claim.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ssmail.paper import (
    c1_stability,
    c2_modes,
    c3_beta,
    c4_noise,
    c5_alpha,
    c6_curricula,
    c7_landscapes,
    c8_vector_field,
)
from ssmail.paper.claims import Claim, Part, Sample
from ssmail.paper.curve_numbers import slope
from ssmail.paper.fig5_modes import shown_lanes, shown_rollouts
from ssmail.paper.samples import Floats, Runs
from ssmail.plots.run_groups import Group
from ssmail.store import RunRow
from ssmail.store.comparison import latest_values

WORST, LEAST = np.inf, -np.inf


class Collector(NamedTuple):
    """A claim and what reads its runs."""

    claim: Claim
    parts: Callable[[Runs], tuple[Part, ...]]


def stability(runs: Runs) -> tuple[Part, ...]:
    """C1: training and validation error over epochs, against constant velocity."""
    methods = {method: runs.group(method) for method in ("ssail", "gail", "wail")}
    errors = {method: _remaining(runs, group, method) for method, group in methods.items()}
    fluctuations = {
        method: _of_curve(runs, group, method, "train/mode_mse", c1_stability.fluctuation, WORST)
        for method, group in methods.items()
    }
    return c1_stability.decide(errors, fluctuations)


def modes(runs: Runs) -> tuple[Part, ...]:
    """C2: where sampled rollouts end."""
    ssail, dnri = runs.group("ssail"), runs.group("dnri")
    return c2_modes.decide(
        ends=runs.metric(ssail, "ssail", "test/on_lane", LEAST),
        balance=runs.metric(ssail, "ssail", "test/lane_balance", LEAST),
        averaged=_of_arrays(runs, dnri, "dnri", ("test/rollouts", "test/lanes"), _between, LEAST),
    )


def beta(runs: Runs) -> tuple[Part, ...]:
    """C3: the test error of three values of beta."""
    wanted = (c3_beta.NONE, c3_beta.CHOSEN, c3_beta.COMPLETE)
    return c3_beta.decide(*(runs.metric(runs.group(b), f"beta {b:g}", "test/mode_mse", WORST) for b in wanted))


def noise(runs: Runs) -> tuple[Part, ...]:
    """C4: errors over predicted steps, with noise on what is read."""
    ssail, dnri = runs.group("ssail"), runs.group("dnri")
    errors, spread = ("test_noisy/mse",), ("test_noisy/mse_spread",)
    return c4_noise.decide(
        growth=_of_arrays(runs, dnri, "dnri", errors, slope, WORST),
        spreading=_of_arrays(runs, dnri, "dnri", spread, slope, WORST),
        bent=_of_arrays(runs, ssail, "ssail", errors, c4_noise.bending, WORST),
        late=_of_arrays(runs, ssail, "ssail", errors, c4_noise.late_slope, WORST),
        late_dnri=_of_arrays(runs, dnri, "dnri", errors, c4_noise.late_slope, WORST),
    )


def alpha(runs: Runs) -> tuple[Part, ...]:
    """C5: training errors over epochs for two ranges of alpha."""
    groups = {_range(value): runs.group(value) for value in (c5_alpha.BOTH, c5_alpha.POSITIVE)}
    finals = [_of_curve(runs, group, name, "train/mse", c5_alpha.final_error, WORST) for name, group in groups.items()]
    level = c5_alpha.common_level([value for sample in finals for value in sample.values])

    def epochs(errors: Floats) -> float:
        return c5_alpha.epochs_to_converge(errors, level)

    sooner = [_of_curve(runs, group, name, "train/mse", epochs, WORST) for name, group in groups.items()]
    return c5_alpha.decide(*finals, *sooner)


def curricula(runs: Runs) -> tuple[Part, ...]:
    """C6: measured segment lengths over epochs."""
    lengths = "curriculum/segment_length"
    forcing, sampling = c6_curricula.FORCING, c6_curricula.SAMPLING
    group, other = runs.group(forcing), runs.group(sampling)
    return c6_curricula.decide(
        grown=_of_curve(runs, group, forcing, lengths, c6_curricula.growth, LEAST),
        jump=_of_curve(runs, group, forcing, lengths, c6_curricula.largest_jump, WORST),
        jump_sampling=_of_curve(runs, other, sampling, lengths, c6_curricula.largest_jump, LEAST),
    )


def landscapes(runs: Runs) -> tuple[Part, ...]:
    """C7: slopes of the learned reward over the plane."""
    ssail, gail = runs.group("ssail"), runs.group("gail")
    return c7_landscapes.decide(
        share_gail=runs.metric(gail, "gail", "landscape/slope_share", WORST),
        share_ssail=runs.metric(ssail, "ssail", "landscape/slope_share", LEAST),
        cosine_ssail=runs.metric(ssail, "ssail", "landscape/cosine", LEAST),
    )


def vector_field(runs: Runs) -> tuple[Part, ...]:
    """C8: the learned reward behind the current trajectory for two ranges of alpha."""
    positive, both = c8_vector_field.POSITIVE, c8_vector_field.BOTH
    return c8_vector_field.decide(
        runs.metric(runs.group(positive), _range(positive), "landscape/behind_cosine", WORST),
        runs.metric(runs.group(both), _range(both), "landscape/behind_cosine", LEAST),
    )


COLLECTORS = tuple(
    Collector(module.CLAIM, parts)
    for module, parts in (
        (c1_stability, stability),
        (c2_modes, modes),
        (c3_beta, beta),
        (c4_noise, noise),
        (c5_alpha, alpha),
        (c6_curricula, curricula),
        (c7_landscapes, landscapes),
        (c8_vector_field, vector_field),
    )
)


def _between(rollouts: npt.NDArray[np.floating], lanes: npt.NDArray[np.floating]) -> float:
    """c2_modes.between of the rollouts that figure 5 shows: a compact database has no others."""
    return c2_modes.between(shown_rollouts(rollouts), shown_lanes(lanes))


def _remaining(runs: Runs, group: Group, label: str) -> Sample:
    """c1_stability.remaining_error of each run."""
    name = "test_constant_velocity/mode_mse"
    references = latest_values(runs.store, group.runs, [name])

    def value(run: RunRow) -> float:
        train, validation = (runs.curve(run, f"{split}/mode_mse") for split in ("train", "validation"))
        return c1_stability.remaining_error(train, validation, references.get((run.id, name), np.nan))

    return runs.sample(group, label, value, WORST)


def _of_curve(
    runs: Runs, group: Group, label: str, metric: str, number: Callable[[Floats], float], diverged: float
) -> Sample:
    """A number of each run's curve over epochs; unknown without one."""

    def value(run: RunRow) -> float:
        curve = runs.curve(run, metric)
        return number(curve) if len(curve) else np.nan

    return runs.sample(group, label, value, diverged)


def _of_arrays(
    runs: Runs, group: Group, label: str, names: tuple[str, ...], number: Callable[..., float], diverged: float
) -> Sample:
    """A number of some arrays of each run; unknown where one is missing."""

    def value(run: RunRow) -> float:
        arrays = runs.arrays(run, *names)
        return np.nan if arrays is None else number(*arrays)

    return runs.sample(group, label, value, diverged)


def _range(value: tuple[Any, ...]) -> str:
    """What a range of alpha is called: "alpha [0, 1]"."""
    return f"alpha [{value[0]:g}, {value[1]:g}]"
