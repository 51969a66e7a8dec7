"""Independent random generators from one seed: changing one use of randomness leaves the others as they were."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssmail.training.checkpoint import entries, fitted_generator

PURPOSES = ("data", "weights", "policy", "alpha", "curriculum", "evaluation")


class Generators:
    """One torch generator per purpose: data order, initial weights, policy noise, alpha, interventions, evaluation.

    A change of the alpha range, for example, does not change the initial weights.
    """

    def __init__(self, seed: int) -> None:
        children = np.random.SeedSequence(seed).spawn(len(PURPOSES))
        self.seeds = {p: int(c.generate_state(1, np.uint64)[0] >> 1) for p, c in zip(PURPOSES, children, strict=True)}
        self.by_purpose = {p: torch.Generator().manual_seed(s) for p, s in self.seeds.items()}

    def __getitem__(self, purpose: str) -> torch.Generator:
        return self.by_purpose[purpose]

    def state_dict(self) -> dict[str, Any]:
        """Return the states of all generators."""
        return {p: g.get_state() for p, g in self.by_purpose.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`, for the same seed. Raises UnfitState when it is another one, or no such state."""
        state = entries(state, self.by_purpose, "generators")
        for purpose, generator in self.by_purpose.items():
            generator.set_state(fitted_generator(state[purpose], generator, f"generators.{purpose}"))


Source = torch.Generator | Sequence[torch.Generator]
"""A generator, or one for each of several seeds, whose draws lie side by side."""


class GeneratorsOfSeeds:
    """The generators of S seeds: those of a purpose, one for each seed."""

    def __init__(self, seeds: Sequence[Generators]) -> None:
        self.seeds = seeds

    def __getitem__(self, purpose: str) -> list[torch.Generator]:
        return [seed[purpose] for seed in self.seeds]


def drawn(source: Source, draw: Callable[[torch.Generator], Tensor]) -> Tensor:
    """Return the draw (...) from a generator, or those from S generators, (S, ...)."""
    return draw(source) if isinstance(source, torch.Generator) else torch.stack([draw(g) for g in source])


def normal_like(x: Tensor, source: Source) -> Tensor:
    """Return standard normal draws of the shape of x, on its device; with S generators, the first axis of x is S."""
    shape = x.shape if isinstance(source, torch.Generator) else x.shape[1:]
    return drawn(source, lambda g: torch.randn(shape, generator=g)).to(x.device)
