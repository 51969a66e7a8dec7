"""Curricula: how often generation is put back on the expert's track (section 3.3)."""

import torch
from torch import Tensor

from ssmail.spec import CurriculumSpec


def intervention_frequency(spec: CurriculumSpec, epoch: int, epochs: int) -> float:
    """Probability of an intervention at each step of epoch 0 .. epochs - 1.

    Trajectory Forcing: f(e) = 1.5 ** (-e / (beta * epochs));
    beta 0 never intervenes, beta 1 always does (complete teacher forcing, section 4.5).
    """
    if spec.name == "none" or spec.beta == 0:
        return 0.0
    if spec.beta == 1:
        return 1.0
    return float(1.5 ** (-epoch / (spec.beta * epochs)))


def draw_interventions(batch: int, steps: int, frequency: float, generator: torch.Generator) -> Tensor:
    """(B, T) booleans: at which steps the whole group is put on the expert's state. Step 0 is the start and never
    counts.
    """
    mask = torch.rand(batch, steps, generator=generator) < frequency
    mask[:, 0] = False
    return mask


def mean_segment_length(interventions: Tensor) -> float:
    """Mean number of generated steps between two interventions (or the trajectory's ends), from a (B, T) mask of
    interventions.

    A trajectory of T steps with k interventions after its start has k + 1 segments, so the mean over a batch is B * T /
    (B + interventions).
    """
    b, t = interventions.shape
    return b * t / (b + int(interventions.sum()))
