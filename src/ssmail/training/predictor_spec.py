"""What a predictor is built from beside its weights.

It is stored with the best model, so that a trained model can be used where its expert set is not.
"""

from dataclasses import asdict, astuple, dataclass, replace
from typing import Any, Self

import torch
from pydantic import ValidationError
from torch import Tensor

from ssmail.config.sections import ModelSpec
from ssmail.config.spec import RunSpec
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import ExpertSet
from ssmail.envs.integrator import Integrator
from ssmail.models.features import Features
from ssmail.models.normalization import ActionBounds, Normalization
from ssmail.training.baselines import ConstantVelocity, CopyLast
from ssmail.training.batches import Batch
from ssmail.training.checkpoint import UnfitState, entries, fitted, fitted_number
from ssmail.training.learner import LearnerContext, Predictor
from ssmail.training.rollout import PolicyPredictor, action_bounds
from ssmail.training.variational import VariationalModel, VariationalPredictor

MOST_AGENTS, MOST_EDGE_TYPES, MOST_AXES = 10_000, 64, 3
LARGEST = 1e30  # of a number in raw units


@dataclass(frozen=True)
class PredictorSpec:
    """Everything but the weights.

    spec: of the run, with what the expert set decided. scaling: that of the training split. state_size: D. features:
    what the networks read, with their normalization; None for a baseline. bounds: of a policy's actions; None for other
    models.
    """

    spec: RunSpec
    scaling: Scaling
    state_size: int
    features: Features | None
    bounds: ActionBounds | None = None

    @classmethod
    def of(cls, context: LearnerContext, predictor: Predictor) -> Self:
        """Describe the predictor of a learner."""
        bounds = predictor.model.actor.bounds if isinstance(predictor, PolicyPredictor) else None
        size = context.experts.states.shape[-1]
        return cls(context.spec, context.integrator.scaling, size, predictor.features, bounds)

    @classmethod
    def from_data(cls, spec: RunSpec, data: ExpertSet) -> Self:
        """Fit to the training split of an expert set, as learners do."""
        experts = Batch.from_trajectories(data.train, data.scaling, torch.device("cpu"))
        section = spec.model or spec.variational
        features = None if section is None else Features.of(section, experts.states)
        bounds = action_bounds(spec.model, features, [experts]) if spec.model and features else None
        return cls(spec, data.scaling, experts.states.shape[-1], features, bounds)

    @property
    def agents(self) -> int | None:
        """The number of agents that the networks can read; None if they can read any."""
        if self.features is None:
            return None
        normalization = self.features.normalization
        rows = 1 if normalization is None else len(normalization.mean)
        return self.features.agents or (rows if rows > 1 else None)

    def state_dict(self) -> dict[str, Any]:
        """Return the values as tensors and plain data."""
        return {
            "spec": self.spec.as_json(),
            "scaling": list(astuple(self.scaling)),
            "state_size": self.state_size,
            "features": None if self.features is None else _described(self.features),
            "bounds": None if self.bounds is None else self._expanded(self.bounds),
        }

    @classmethod
    def from_state(cls, found: Any) -> Self:
        """Inverse of `state_dict`, for what anyone may have written. Raises UnfitState."""
        where = "predictor"
        state = entries(found, ("spec", "scaling", "state_size", "features", "bounds"), where)
        try:
            spec = RunSpec.model_validate_json(state["spec"])
        except (ValidationError, TypeError):
            raise UnfitState(f"{where}.spec is that of another version of ssmail") from None
        size = fitted_number(state["state_size"], 2, 2 * MOST_AXES, f"{where}.state_size")
        if size % 2 or not isinstance(state["scaling"], list) or len(state["scaling"]) != 4:
            raise UnfitState(f"{where} has another shape")
        scaling = Scaling(*(fitted_number(end, -LARGEST, LARGEST, f"{where}.scaling") for end in state["scaling"]))
        if min(scaling.position_span, scaling.velocity_span) <= 0:
            raise UnfitState(f"{where}.scaling is out of range")
        if (state["features"] is None) != (spec.model is None and spec.variational is None):
            raise UnfitState(f"{where}.features is of another type")
        features = None if state["features"] is None else _features(state["features"], size, f"{where}.features")
        made = cls(spec, scaling, size, features)
        if (state["bounds"] is None) != (spec.model is None):
            raise UnfitState(f"{where}.bounds is of another type")
        if features is None or spec.model is None:
            return made
        zero = torch.tensor(0.0)
        bounds = ActionBounds(
            **fitted(state["bounds"], made._expanded(ActionBounds(zero, zero, zero)), f"{where}.bounds")
        )
        finite = all(bool(torch.isfinite(part).all()) for part in vars(bounds).values())
        if not finite or not bool((bounds.step > 0).all()):
            raise UnfitState(f"{where}.bounds is out of range")
        return replace(made, bounds=bounds)

    def _expanded(self, bounds: ActionBounds) -> dict[str, Tensor]:
        """Return the parts of bounds as (N, A) each, with N = 1 if they are those of all agents."""
        normalization = None if self.features is None else self.features.normalization
        rows = 1 if normalization is None else len(normalization.mean)
        return {name: part.expand(rows, self.state_size // 2).clone() for name, part in vars(bounds).items()}

    def make(self, weights: Any) -> Predictor:
        """Return the predictor with these weights, the state of its network. Raises UnfitState when it is not.

        The network is laid out without memory first: only one that is as large as the given weights is made.
        """
        try:
            with torch.device("meta"):
                expected = self._untrained().model.state_dict()
        except RuntimeError:
            raise UnfitState("its networks are too large") from None
        state = fitted(weights, expected, "weights")
        if not all(bool(torch.isfinite(value).all()) for value in state.values()):
            raise UnfitState("a weight is not finite")
        predictor = self._untrained()
        predictor.model.load_state_dict(state)
        predictor.model.eval().requires_grad_(False)
        return predictor

    def _untrained(self) -> Predictor:
        """Make the predictor with arbitrary weights."""
        integrator, spec = Integrator(self.scaling), self.spec
        section = spec.model or spec.variational
        if section is None or self.features is None:
            return ConstantVelocity(integrator) if spec.method == "constant-velocity" else CopyLast()
        if section.edge_types > MOST_EDGE_TYPES:
            raise UnfitState(f"its networks have more than {MOST_EDGE_TYPES} edge types")
        with torch.random.fork_rng(devices=[]):
            if isinstance(section, ModelSpec):
                assert self.bounds is not None
                return PolicyPredictor.untrained(section, self.features, self.bounds, self.state_size, integrator)
            model = VariationalModel(self.features, self.state_size, section, dynamic=spec.method == "dnri")
            return VariationalPredictor(model, integrator)


def last_weights(spec: RunSpec, checkpoint: Any) -> Any:
    """Return the weights of the model after the last epoch from the state of a TrainingLoop. Raises UnfitState.

    They are those of the averaged policy where the run has one, as in its evaluation.
    """
    learner = dict(checkpoint).get("learner")
    if spec.sac is not None and isinstance(learner, dict):
        name, learner = "averaged" if spec.sac.average is not None else "policy", learner.get("actor_critic")
    else:
        name = "policy" if spec.variational is None else "model"
    if not isinstance(learner, dict) or name not in learner:
        raise UnfitState("it holds no model of this method")
    return learner[name]


def _described(features: Features) -> dict[str, Any]:
    """Return the fields of features, with tensors for those of their normalization."""
    return asdict(replace(features, normalization=None)) | {
        "normalization": None if features.normalization is None else dict(vars(features.normalization))
    }


def _features(found: Any, state_size: int, where: str) -> Features:
    """Inverse of `_described`. A field that is younger than the checkpoint has its default. Raises UnfitState."""
    plain = asdict(Features(time=False, start=False, steps=2))
    if not isinstance(found, dict) or not {"time", "start", "steps", "normalization"} <= dict.keys(found):
        raise UnfitState(f"{where} has other entries")
    values = fitted({**plain, **found, "normalization": None}, plain, where)
    fitted_number(values["steps"], 2, 10**9, f"{where}.steps")
    fitted_number(values["agents"], 0, MOST_AGENTS, f"{where}.agents")
    normalization = dict.__getitem__(found, "normalization")
    if normalization is not None:
        values["normalization"] = _normalization(normalization, values["agents"], state_size, f"{where}.normalization")
    return Features(**values)


def _normalization(found: Any, agents: int, state_size: int, where: str) -> Normalization:
    """Return the normalization of `agents` agents, or of any number if 0. Raises UnfitState."""
    parts = entries(found, ("mean", "std"), where)
    rows = len(parts["mean"]) if isinstance(parts["mean"], Tensor) and parts["mean"].dim() == 2 else 0
    if not 1 <= rows <= MOST_AGENTS or (agents and rows not in (1, agents)):
        raise UnfitState(f"{where} has another shape or type")
    like = torch.zeros(rows, state_size)
    normalization = Normalization(**{name: fitted(part, like, f"{where}.{name}") for name, part in parts.items()})
    finite = bool(torch.isfinite(torch.cat([normalization.mean, normalization.std])).all())
    if not finite or not bool((normalization.std > 0).all()):
        raise UnfitState(f"{where} is out of range")
    return normalization
