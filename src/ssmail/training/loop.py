"""The training loop: epochs of training and validation, the best model, landscapes, and the state to resume from.

The loop returns metrics and does not know where they are stored.
"""

import math
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch

from ssmail.config.spec import RunSpec
from ssmail.data.expert_sets import generate, load
from ssmail.data.trajectories import ExpertSet
from ssmail.envs.integrator import Integrator
from ssmail.errors import SsmailError
from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.agent_numbers import batches_by_number
from ssmail.training.baselines import BaselineLearner, ConstantVelocity, CopyLast
from ssmail.training.batches import Arrays
from ssmail.training.checkpoint import UnfitState, entries, fitted, fitted_number, load_part
from ssmail.training.cloning import CloningLearner
from ssmail.training.data_defaults import resolve
from ssmail.training.evaluators import Evaluator, ForecastEvaluator, LaneEvaluator, LetterEvaluator
from ssmail.training.landscape_recorder import LandscapeRecorder, landscape_epochs
from ssmail.training.learner import Learner, LearnerContext
from ssmail.training.predictor_spec import PredictorSpec
from ssmail.training.seeding import Generators
from ssmail.training.trajectory_evaluator import TrajectoryEvaluator
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

EVALUATORS: dict[str, type[Evaluator]] = {
    "yjunction": LaneEvaluator,
    "letters": LetterEvaluator,
    "mocap": ForecastEvaluator,
    "trajectories": TrajectoryEvaluator,
}
"""The table of environments."""


class Divergence(SsmailError):  # noqa: N818 - an outcome of training, not a fault
    """Weights became NaN or infinite."""


def expert_set(spec: RunSpec, seed: int) -> ExpertSet:
    """Load the expert data of a spec from its file, or generate it for this seed if the spec names none."""
    if spec.data.path is not None:
        return load(Path(spec.data.path), spec.environment)
    return generate(spec.data, seed)


class TrainingLoop:
    """One run. Call `run_epoch` until `epoch` reaches spec.epochs, then `final_evaluation`.

    snapshot: the arrays to store of the epoch that has just ended, or of the untrained model; mostly empty.
    improved: whether the epoch that has just ended is the best so far.
    """

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        self.spec, self.device = spec, torch.device(device)
        self.data = expert_set(spec, seed)
        self.dataset_hash = self.data.hash
        self.scaling = self.data.scaling
        self.generators = Generators(seed)
        self.experts, *others = batches_by_number(self.data.train, self.scaling, self.device)
        self.integrator = Integrator(self.scaling)
        self.resolved = resolve(spec, self.data, [self.experts, *others])
        context = LearnerContext(self.resolved, self.experts, self.integrator, self.generators, tuple(others))
        self.learner = LEARNERS[spec.method](context)
        self.evaluator = EVALUATORS[spec.environment](context, self.data)
        self.predictor_spec = PredictorSpec.of(context, self.learner.predictor)
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
        (outcome,) = self.run_epochs([self])
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    @staticmethod
    def run_epochs(loops: "Sequence[TrainingLoop]") -> Sequence[dict[str, float] | Exception]:
        """Train and validate seeds of one spec, all before the same epoch, for one epoch.

        Returns, for each, what `run_epoch` of the seed alone would return or raise.
        """
        trained: dict[int, tuple[dict[str, float], float]] = {}
        for group in _side_by_side(loops):
            began = time.perf_counter()
            learners = [loop.learner for loop in group if isinstance(loop.learner, AdversarialLearner)]
            if len(learners) == len(group):
                values = AdversarialLearner.run_epochs(learners, loops[0].epoch)
            else:
                values = [loop.learner.run_epoch(loop.epoch) for loop in group]
            share = (time.perf_counter() - began) / len(group)
            trained |= {id(loop): (own, share) for loop, own in zip(group, values, strict=True)}
        return [loop._after_training(*trained[id(loop)]) for loop in loops]

    def _after_training(self, values: dict[str, float], seconds: float) -> "dict[str, float] | Divergence":
        """Validate after an epoch of training that took `seconds`, and return all metrics of the epoch."""
        began = time.perf_counter()
        if not self._is_finite():
            return Divergence(f"weights became NaN or infinite in epoch {self.epoch + 1}")
        # 1. Validate, drawing from the evaluation generator. 2. Count the epoch and compare it with the best one.
        values |= self.evaluator.epoch(self.learner.predictor)
        self.epoch += 1
        self._select(*self.evaluator.rank(values))
        # 3. Record a landscape, with its own generator.
        values |= self._record_landscape()
        return values | {"seconds": seconds + time.perf_counter() - began}

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
        weights = {name: value.clone() for name, value in self.learner.predictor.model.state_dict().items()}
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
        """Inverse of `state_dict`, for a loop with the same spec and seed.

        Raises UnfitState when the state is not one of such a loop; some of it may be loaded by then.
        """
        own, parts = self.state_dict(), self.learner.parts()
        state = entries(state, own, "it")
        learner = entries(state["learner"], parts, "learner")
        self.epoch, self.snapshot = fitted_number(state["epoch"], 0, self.spec.epochs, "epoch"), {}
        self.best = fitted(state["best"], own["best"], "best")
        fitted_number(self.best["epoch"], 0, self.epoch, "best.epoch")
        for name, part in parts.items():
            load_part(part, learner[name], f"learner.{name}")
        self.generators.load_state_dict(state["generators"])
        if not self._is_finite():
            raise UnfitState("a weight is not finite")

    def best_state_dict(self) -> dict[str, Any]:
        """Return the weights with the best validation error so far, with their epoch and error, and what a predictor
        needs beside weights.
        """
        best = {"epoch": self.best["epoch"], "error": self.best["error"], "policy": self.best["weights"]}
        return {**best, "predictor": self.predictor_spec.state_dict()}

    @property
    def _decided(self) -> str:
        """The data, if they decide more than the scaling; networks of seeds that differ in it are not stacked."""
        model = self.spec.model
        given = model is not None and not model.standardize and None not in (model.action_step, model.action_bound)
        return "" if given and self.resolved == self.spec else self.dataset_hash

    def _is_finite(self) -> bool:
        parameters = (p for network in self.learner.networks() for p in network.parameters())
        return all(bool(torch.isfinite(p).all()) for p in parameters)


def _side_by_side(loops: Sequence[TrainingLoop]) -> list[list[TrainingLoop]]:
    """Return the loops in groups whose networks can be stacked."""
    groups: dict[str, list[TrainingLoop]] = {}
    for loop in loops:
        groups.setdefault(loop._decided, []).append(loop)
    return list(groups.values())
