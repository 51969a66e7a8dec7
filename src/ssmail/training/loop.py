"""The training loop: epochs of training and validation, the best model, landscapes, and checkpoints.

The loop returns metrics and does not know where they are stored.
"""

import math
import time
import zipfile
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch

from ssmail.config.spec import RunSpec
from ssmail.data.atomic_file import atomic_write
from ssmail.data.expert_sets import generate, load
from ssmail.data.trajectories import ExpertSet
from ssmail.envs.integrator import Integrator
from ssmail.errors import InputError, SsmailError
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.baselines import BaselineLearner, ConstantVelocity, CopyLast
from ssmail.training.batches import Arrays, Batch
from ssmail.training.cloning import CloningLearner
from ssmail.training.evaluators import make_evaluator
from ssmail.training.landscape_recorder import LandscapeRecorder, landscape_epochs
from ssmail.training.learner import Learner, LearnerContext
from ssmail.training.seeding import Generators
from ssmail.training.variational import VariationalLearner

LEARNERS: dict[str, Callable[[LearnerContext], Learner]] = {
    "ssail": AdversarialLearner,
    "gail": AdversarialLearner,
    "wail": AdversarialLearner,
    "bc": CloningLearner,
    "nri": VariationalLearner,
    "dnri": VariationalLearner,
    "constant-velocity": lambda context: BaselineLearner(ConstantVelocity(context.integrator)),
    "copy-last": lambda context: BaselineLearner(CopyLast()),
}
"""The table of methods."""


class Divergence(SsmailError):  # noqa: N818 - an outcome of training, not a fault
    """Weights became NaN or infinite."""


def expert_set(spec: RunSpec) -> ExpertSet:
    """Load the expert data of a spec from its file, or generate it if the spec names none."""
    if spec.data.path is not None:
        return load(Path(spec.data.path), spec.environment)
    return generate(spec.data)


class TrainingLoop:
    """One run. Call `run_epoch` until `epoch` reaches spec.epochs, then `final_evaluation`.

    snapshot: the arrays to store of the epoch that has just ended, or of the untrained model; mostly empty.
    improved: whether the epoch that has just ended is the best so far.
    """

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        self.spec, self.device = spec, torch.device(device)
        self.data = expert_set(spec)
        self.dataset_hash = self.data.hash
        self.scaling = self.data.scaling
        self.generators = Generators(seed)
        self.experts = Batch.from_trajectories(self.data.train, self.scaling, self.device)
        self.integrator = Integrator(self.scaling)
        context = LearnerContext(spec, self.experts, self.integrator, self.generators)
        self.learner = LEARNERS[spec.method](context)
        self.evaluator = make_evaluator(context, self.data)
        self.epoch = 0
        self.improved = False
        self.best = self._as_best(True, math.inf)
        self.untrained = deepcopy(self.learner.predictor)
        self.landscapes = LandscapeRecorder.for_learner(context, self.learner)
        self.snapshot: Arrays = {}
        self._record_landscape()

    def run_epoch(self) -> dict[str, float]:
        """Train and validate for one epoch and return its metrics.

        Raises Divergence if a weight is not finite. The order of the steps is part of a run's numbers: a checkpoint
        taken after the call continues as if never interrupted.
        """
        began = time.perf_counter()
        # 1. Train. 2. Validate, drawing from the evaluation generator.
        values = self.learner.run_epoch(self.epoch)
        self._check_finite()
        values |= self.evaluator.epoch(self.learner.predictor)
        # 3. Count the epoch and compare it with the best one. 4. Record a landscape, with its own generator.
        self.epoch += 1
        self._select(*self.evaluator.rank(values))
        values |= self._record_landscape()
        return values | {"seconds": time.perf_counter() - began}

    def _record_landscape(self) -> dict[str, float]:
        """Put this epoch's landscape into `snapshot` and return its metrics, if the spec asks for one."""
        values: dict[str, float] = {}
        self.snapshot = {}
        if self.landscapes is not None and self.epoch in landscape_epochs(self.spec):
            values, self.snapshot = self.landscapes.record(self.epoch)
        return values

    def _select(self, flawed: bool, error: float) -> None:
        """Keep this epoch's weights if the evaluator ranks it best so far."""
        self.improved = (flawed, error) < (self.best["flawed"], self.best["error"])
        if self.improved:
            self.best = self._as_best(flawed, error)

    def _as_best(self, flawed: bool, error: float) -> dict[str, Any]:
        weights = deepcopy(self.learner.predictor.model.state_dict())
        return {"flawed": flawed, "error": error, "epoch": self.epoch, "weights": weights}

    def final_evaluation(self) -> tuple[dict[str, float], Arrays]:
        """Return the metrics of the best and the last model on the test split, and the arrays to draw."""
        best = deepcopy(self.learner.predictor)
        best.model.load_state_dict(self.best["weights"])
        values, arrays = self.evaluator.final(best, self.learner.predictor, self.untrained)
        return {"best_epoch": float(self.best["epoch"]), **values}, arrays

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to continue as if never interrupted, as tensors and plain data."""
        return {
            "epoch": self.epoch,
            "best": self.best,
            "learner": {name: part.state_dict() for name, part in self.learner.parts().items()},
            "generators": self.generators.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`, for a loop with the same spec and seed."""
        self.epoch, self.best, self.snapshot = state["epoch"], state["best"], {}
        for name, part in self.learner.parts().items():
            part.load_state_dict(state["learner"][name])
        self.generators.load_state_dict(state["generators"])

    def best_state_dict(self) -> dict[str, Any]:
        """Return the weights with the best validation error so far, with their epoch and error."""
        return {"epoch": self.best["epoch"], "error": self.best["error"], "policy": self.best["weights"]}

    def _check_finite(self) -> None:
        for network in self.learner.networks():
            if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
                raise Divergence(f"weights became NaN or infinite in epoch {self.epoch + 1}")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write `state` (nested dicts and lists of tensors and plain data) to `path` and create its folder.

    The write is atomic: after a crash or a power cut the file is either the old one or the new one. Raises InputError
    if the file cannot be written.
    """
    try:
        with atomic_write(path) as partial, partial.open("wb") as file:
            torch.save(state, file)
    except OSError as error:
        raise InputError(
            f"cannot write the checkpoint {path} ({error.strerror}); free or choose another place"
        ) from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return the state that `save_checkpoint` wrote, on the CPU, without running any code that the file holds.

    Raises InputError if the file is missing or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not verify the checksums that it writes
            if archive.testzip() is not None:
                raise zipfile.BadZipFile("wrong checksum")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged bytes can make the unpickler raise anything
        raise InputError(
            f"the checkpoint {path} cannot be read ({type(error).__name__}); start afresh with --resume never"
        ) from error
    if not isinstance(state, dict):
        raise InputError(f"{path} is not a checkpoint of ssmail; start afresh with --resume never")
    return state
