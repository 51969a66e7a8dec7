"""The training loop: epochs of rollouts and updates, validation, the best model, and everything needed to continue
later.

It yields metrics and knows nothing of where they are stored.
"""

import math
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssmail.config.spec import RunSpec
from ssmail.data.expert_sets import generate, load
from ssmail.data.trajectories import ExpertSet
from ssmail.envs.integrator import Integrator
from ssmail.errors import SsmailError
from ssmail.training.evaluators import make_evaluator
from ssmail.training.experts import scaled_batch
from ssmail.training.landscapes import Landscapes, looks
from ssmail.training.learning import Setting
from ssmail.training.methods import make_learner
from ssmail.training.seeding import Generators


class Divergence(SsmailError):  # noqa: N818 - an outcome of training, not a fault
    """Training left the finite numbers."""


def expert_set(spec: RunSpec) -> ExpertSet:
    """The expert data of a spec: its file, or the generator's set when it names none."""
    if spec.data.path is not None:
        return load(Path(spec.data.path), spec.environment)
    return generate(spec.data)


class TrainingLoop:
    """One run. Call `run_epoch` until `epoch` reaches spec.epochs, then `final_evaluation`.

    `snapshot` holds the arrays to keep of the epoch that has just ended, or of the untrained model; mostly none.
    """

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        self.spec, self.device = spec, torch.device(device)
        self.data = expert_set(spec)
        self.dataset_hash = self.data.hash
        self.scaling = self.data.scaling
        self.generators = Generators(seed)
        self.experts = scaled_batch(self.data.train, self.scaling, self.device)
        self.integrator = Integrator(self.scaling)
        setting = Setting(spec, self.experts, self.integrator, self.generators)
        self.learner = make_learner(setting)
        self.evaluator = make_evaluator(spec, self.data, setting)
        self.epoch = 0
        self.improved = False
        self.best_flawed = True
        self.best_error = math.inf
        self.best_epoch = 0
        self.best_weights = deepcopy(self.learner.predictor.state_dict())
        self.untrained = deepcopy(self.learner.predictor)
        self.landscapes = Landscapes.of(setting, self.learner)
        self.snapshot: dict[str, np.ndarray] = {}
        self._look()

    def run_epoch(self) -> dict[str, float]:
        """One epoch of training and its validation; returns the epoch's metrics. Raises Divergence when weights stop
        being finite.
        """
        began = time.perf_counter()
        values = self.learner.run_epoch(self.epoch)
        self._check_finite()
        values |= self.evaluator.epoch(self.learner.predictor)
        self.epoch += 1
        self._select(*self.evaluator.rank(values))
        values |= self._look()
        return values | {"seconds": time.perf_counter() - began}

    def _look(self) -> dict[str, float]:
        """Look at the learned reward, if this is an epoch for it: the numbers; the arrays are `snapshot`."""
        values: dict[str, float] = {}
        self.snapshot = {}
        if self.landscapes is not None and self.epoch in looks(self.spec):
            values, self.snapshot = self.landscapes.look(self.epoch)
        return values

    def _select(self, flawed: bool, error: float) -> None:
        """Keep this epoch's model if it is the best so far by the evaluator's rank."""
        self.improved = (flawed, error) < (self.best_flawed, self.best_error)
        if self.improved:
            self.best_flawed, self.best_error, self.best_epoch = flawed, error, self.epoch
            self.best_weights = deepcopy(self.learner.predictor.state_dict())

    def final_evaluation(self) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """The metrics of the best and the last model on the test split, and the arrays to draw."""
        best = deepcopy(self.learner.predictor)
        best.load_state_dict(self.best_weights)
        values, arrays = self.evaluator.final(best, self.learner.predictor)
        return {"best_epoch": float(self.best_epoch), **values}, {**arrays, **self.evaluator.beginning(self.untrained)}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue as if never interrupted: tensors and plain data only."""
        return {
            "epoch": self.epoch,
            "best": {
                "flawed": self.best_flawed,
                "error": self.best_error,
                "epoch": self.best_epoch,
                "weights": self.best_weights,
            },
            "learner": self.learner.state_dict(),
            "generators": self.generators.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`, for a loop made with the same spec and seed."""
        self.epoch, self.snapshot = state["epoch"], {}
        best = state["best"]
        self.best_flawed, self.best_error = best["flawed"], best["error"]
        self.best_epoch, self.best_weights = best["epoch"], best["weights"]
        self.learner.load_state_dict(state["learner"])
        self.generators.load_state_dict(state["generators"])

    def best_state_dict(self) -> dict[str, Any]:
        """The policy of the best validation error so far, with its epoch and error."""
        return {"epoch": self.best_epoch, "error": self.best_error, "policy": self.best_weights}

    def _check_finite(self) -> None:
        for network in self.learner.networks():
            if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
                raise Divergence(f"weights became NaN or infinite in epoch {self.epoch + 1}")
