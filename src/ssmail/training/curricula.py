"""Curricula: how often a rollout is put back on the expert's track (section 3.3)."""

import torch
from torch import Tensor

from ssmail.config.sections import CurriculumSpec


def intervention_frequency(spec: CurriculumSpec, epoch: int, epochs: int) -> float:
    """Return the probability of an intervention at each step of epoch 0 .. epochs - 1.

    none: 0. teacher-forcing: `rate` in every epoch. trajectory-forcing and scheduled-sampling: the functions
    `trajectory_forcing` and `scheduled_sampling` of x = epoch / epochs.
    """
    x = epoch / epochs
    if spec.name == "trajectory-forcing":
        return trajectory_forcing(x, spec.beta)
    if spec.name == "scheduled-sampling":
        return scheduled_sampling(x, spec.decay, spec.half_life, spec.steepness)
    return spec.rate if spec.name == "teacher-forcing" else 0.0


def trajectory_forcing(x: float, beta: float) -> float:
    """Return f = 1.5 ** (-x / beta) at the fraction x of training (section 3.3).

    The limits are those of section 4.5: beta 0 never intervenes, beta 1 always does (complete teacher forcing).
    """
    if beta == 0:
        return 0.0
    if beta == 1:
        return 1.0
    return float(1.5 ** (-x / beta))


def scheduled_sampling(x: float, decay: str, half_life: float, steepness: float) -> float:
    """Return a decay of Bengio et al. (2015), section 2.4, scaled to reach 1/2 at the fraction x = `half_life` = h.

    linear: max(0, 1 - x / (2 h)). exponential: 2 ** (-x / h). inverse-sigmoid: k / (k + k ** (x / h)), which starts at
    k / (k + 1); k is `steepness`.
    """
    if decay == "linear":
        return max(0.0, 1 - x / (2 * half_life))
    if decay == "exponential":
        return float(2 ** (-x / half_life))
    return float(1 / (1 + steepness ** (x / half_life - 1)))


def draw_interventions(batch: int, steps: int, frequency: float, generator: torch.Generator) -> Tensor:
    """Draw the steps at which the whole group is moved to the expert's state: (B, T) booleans, False at step 0."""
    mask = torch.rand(batch, steps, generator=generator) < frequency
    mask[:, 0] = False
    return mask


def mean_segment_length(interventions: Tensor) -> float:
    """Return the mean number of steps between interventions or trajectory ends, from a mask (B, T).

    A trajectory with k interventions has k + 1 segments, so the mean over a batch is B * T / (B + interventions).
    """
    b, t = interventions.shape
    return b * t / (b + int(interventions.sum()))


def expected_segment_length(frequency: float, steps: int) -> float:
    """Return the limit of `mean_segment_length` in large batches: T / (1 + (T - 1) f), as step 0 never counts."""
    return steps / (1 + (steps - 1) * frequency)


def curriculum_metrics(frequency: float, interventions: list[Tensor]) -> dict[str, float]:
    """Return an epoch's metrics: the frequency, and the mean segment length of its masks (B, T) and its expectation."""
    return {
        "curriculum/intervention_frequency": frequency,
        "curriculum/segment_length": sum(map(mean_segment_length, interventions)) / len(interventions),
        "curriculum/expected_segment_length": expected_segment_length(frequency, interventions[0].shape[1]),
    }
