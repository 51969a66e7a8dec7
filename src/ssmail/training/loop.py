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
from torch import Tensor

from ssmail.data.expert_file import load
from ssmail.data.trajectories import ExpertSet, Floats, Trajectories
from ssmail.data.yjunction import generate
from ssmail.envs.integrator import Integrator
from ssmail.errors import SsmailError
from ssmail.evaluation.protocol import full_metrics, one_step_mse, quick_metrics
from ssmail.spec import DataSpec, RunSpec
from ssmail.training.learning import Predictor, Setting
from ssmail.training.methods import make_learner
from ssmail.training.references import ConstantVelocity
from ssmail.training.replay import Batch
from ssmail.training.seeding import Generators


class Divergence(SsmailError):  # noqa: N818 - an outcome of training, not a fault
    """Training left the finite numbers."""


def expert_set(spec: DataSpec) -> ExpertSet:
    """The expert data of a spec: its file, or the generator's set when it names none."""
    return generate(spec.yjunction) if spec.path is None else load(Path(spec.path))


class TrainingLoop:
    """One run. Call `run_epoch` until `epoch` reaches spec.epochs, then `final_evaluation`."""

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        self.spec, self.device = spec, torch.device(device)
        self.data = expert_set(spec.data)
        self.dataset_hash = self.data.hash
        self.scaling = self.data.scaling
        self.generators = Generators(seed)
        self.experts = self._scaled(self.data.train)
        self.validation_start = self._scaled(self.data.validation).states[:, 0]
        self.integrator = Integrator(self.scaling)
        self.learner = make_learner(Setting(spec, self.experts, self.integrator, self.generators))
        self.epoch = 0
        self.improved = False
        self.best_neglects = True
        self.best_error = math.inf
        self.best_epoch = 0
        self.best_weights = deepcopy(self.learner.predictor.state_dict())

    def run_epoch(self) -> dict[str, float]:
        """One epoch of training and its validation; returns the epoch's metrics. Raises Divergence when weights stop
        being finite.
        """
        began = time.perf_counter()
        values = self.learner.run_epoch(self.epoch)
        self._check_finite()
        values |= self._validate()
        self.epoch += 1
        self._select(values["validation/mode_mse"], values["validation/lane_balance"])
        return values | {"seconds": time.perf_counter() - began}

    def _select(self, error: float, balance: float) -> None:
        """Keep this epoch's model if it is the best so far: the smallest error among those that use every mode.

        The error is the distance to the nearest mode, so by itself it would prefer a model that dropped one.
        """
        neglects = balance < self.spec.evaluation.least_balance or not math.isfinite(error)
        self.improved = (neglects, error) < (self.best_neglects, self.best_error)
        if self.improved:
            self.best_neglects, self.best_error, self.best_epoch = neglects, error, self.epoch
            self.best_weights = deepcopy(self.learner.predictor.state_dict())

    def final_evaluation(self) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Metrics of the best-validation model on the test split (sampled, mean), of the last model, and of constant
        velocity; and the arrays to draw.
        """
        truth, lines = self.data.test, self.data.centre_lines
        last, reference = self.learner.predictor, ConstantVelocity(self.integrator)
        best = deepcopy(last)
        best.load_state_dict(self.best_weights)
        sampled = self._samples(best, truth)
        candidates = {
            "test": (best, sampled),
            "test_mean": (best, self._samples(best, truth, deterministic=True)),
            "test_last": (last, self._samples(last, truth)),
            "test_constant_velocity": (reference, self._samples(reference, truth, samples=1)),
        }
        values = {"best_epoch": float(self.best_epoch)}
        for prefix, (predictor, samples) in candidates.items():
            measured = full_metrics(samples, truth, lines, self.scaling)
            measured["one_step_mse"] = self._one_step(predictor, truth)
            values |= {f"{prefix}/{k}": v for k, v in measured.items()}
        arrays: dict[str, np.ndarray] = {
            "test/rollouts": sampled.astype(np.float32),
            "test/expert": truth.positions.astype(np.float32),
            "test/lanes": truth.continuations.astype(np.float32),
            "train/expert": self.data.train.positions.astype(np.float32),
            "train/lane": self.data.train.mode,
            "lane_centres": lines.astype(np.float32),
        }
        return values, arrays

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue as if never interrupted: tensors and plain data only."""
        return {
            "epoch": self.epoch,
            "best": {
                "neglects": self.best_neglects,
                "error": self.best_error,
                "epoch": self.best_epoch,
                "weights": self.best_weights,
            },
            "learner": self.learner.state_dict(),
            "generators": self.generators.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`, for a loop made with the same spec and seed."""
        self.epoch = state["epoch"]
        best = state["best"]
        self.best_neglects, self.best_error = best["neglects"], best["error"]
        self.best_epoch, self.best_weights = best["epoch"], best["weights"]
        self.learner.load_state_dict(state["learner"])
        self.generators.load_state_dict(state["generators"])

    def best_state_dict(self) -> dict[str, Any]:
        """The policy of the best validation error so far, with its epoch and error."""
        return {"epoch": self.best_epoch, "error": self.best_error, "policy": self.best_weights}

    def _scaled(self, trajectories: Trajectories) -> Batch:
        """Scaled states (B, T, N, 2P) and the actions (B, T - 1, N, P) that led from each to the next."""
        velocities = self.scaling.scale_velocities(trajectories.velocities)
        states = np.concatenate([self.scaling.scale_positions(trajectories.positions), velocities], axis=-1)
        source = torch.arange(len(trajectories), device=self.device)
        return Batch(self._tensor(states), self._tensor(velocities[:, 1:]), source)

    def _tensor(self, array: Floats) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=self.device)

    def _check_finite(self) -> None:
        for network in self.learner.networks():
            if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
                raise Divergence(f"weights became NaN or infinite in epoch {self.epoch + 1}")

    def _validate(self) -> dict[str, float]:
        """Free-running sampled rollouts from every validation start and from some training starts."""
        count = min(self.spec.evaluation.train_rollouts, len(self.data.train))
        chosen = torch.randperm(len(self.data.train), generator=self.generators["evaluation"])[:count]
        validation, train = self.data.validation, self.data.train[chosen.numpy()]
        start = torch.cat([self.validation_start, self.experts.states[chosen.to(self.device), 0]])
        positions = self._free_run(self.learner.predictor, start)
        values: dict[str, float] = {}
        parts = {
            "validation": (positions[: len(validation)], validation),
            "train": (positions[len(validation) :], train),
        }
        for split, (predicted, truth) in parts.items():
            measured = quick_metrics(predicted, truth, self.data.centre_lines, self.scaling)
            values |= {f"{split}/{k}": v for k, v in measured.items()}
        return values

    def _free_run(self, predictor: Predictor, start: Tensor, deterministic: bool = False) -> Floats:
        """Raw positions (B, T, N, P) of one free-running rollout from each start (B, N, D), the start included."""
        steps, generator = self.experts.actions.shape[1], self.generators["evaluation"]
        states = predictor.free_run(start, steps, generator, deterministic=deterministic)
        scaled = states[..., : states.shape[-1] // 2].double().cpu().numpy()
        raw: Floats = self.scaling.unscale_positions(scaled)
        return raw

    def _samples(
        self, predictor: Predictor, truth: Trajectories, deterministic: bool = False, samples: int | None = None
    ) -> Floats:
        """(S, B, T, N, P) raw positions: S rollouts of every start, spec.evaluation.samples by default."""
        start = self._scaled(truth).states[:, 0]
        s = samples or self.spec.evaluation.samples
        positions = self._free_run(predictor, start.repeat(s, 1, 1), deterministic)
        return positions.reshape(s, len(truth), *positions.shape[1:])

    def _one_step(self, predictor: Predictor, truth: Trajectories) -> float:
        states = self._scaled(truth).states
        predicted = predictor.one_step(states, self.generators["evaluation"])
        return one_step_mse(predicted.double().cpu().numpy(), states[:, 1:].double().cpu().numpy())
