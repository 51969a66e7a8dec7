"""The trained model of a stored run, in the units of its data: `load_run` returns a `TrainedRun`."""

import json
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from pydantic import ValidationError

from ssmail.config.spec import RunSpec
from ssmail.data.expert_sets import generate, load
from ssmail.data.scaling import Scaling
from ssmail.data.trajectories import Floats, largest_scaled
from ssmail.errors import InputError
from ssmail.store import RunRow, Store
from ssmail.store.checkpoint_files import BEST, LAST
from ssmail.store.connection import as_url
from ssmail.store.maintenance.whole_databases import existing
from ssmail.store.recorded_checkpoints import load_recorded
from ssmail.training.batches import to_numpy
from ssmail.training.checkpoint import UnfitState, fitted_number
from ssmail.training.learner import Predictor
from ssmail.training.predictor_spec import PredictorSpec, last_weights

Model = Literal["best", "last"]
TOGETHER = 128  # trajectories that are predicted at once
IDENTITY = Scaling(-1.0, 1.0, -1.0, 1.0)


@dataclass(frozen=True)
class TrainedRun:
    """The trained model of a stored run.

    id, spec_hash, seed, dataset_hash: of the run. spec: its settings, with what the data decided.
    metrics: the last value of each metric by its stored name; "test/..." is measured with the best model,
    "test_last/..." with the last one.
    model, epoch: which model this is, and the epoch after which it was kept.
    scaling: between raw units and the [-1, 1] in which `predictor` works.
    axes, agents: the numbers P of axes and N of agents that the model can predict; None if any.
    """

    id: str
    spec_hash: str
    seed: int
    dataset_hash: str | None = field(repr=False)
    spec: RunSpec = field(repr=False)
    metrics: Mapping[str, float] = field(repr=False)
    model: Model
    epoch: int
    axes: int | None
    agents: int | None
    scaling: Scaling
    predictor: Predictor = field(repr=False)

    @property
    def observed(self) -> int | None:
        """The number of states after which the run was tested: the frames of its forecasts, or the first state alone.

        None if the expert set decides, for a baseline.
        """
        return 1 if self.spec.forecast is None else self.spec.forecast.observed

    @property
    def predicted(self) -> int | None:
        """The number of steps over which the run was tested; None if the expert set decides, for a baseline."""
        if self.spec.forecast is not None:
            return self.spec.forecast.predicted
        if self.predictor.features is not None:
            return self.predictor.features.steps - 1
        generated = self.spec.data.letters or self.spec.data.yjunction
        return None if generated is None or self.spec.data.path else generated.steps - 1

    def most_steps(self, frames: int) -> int | None:
        """Return how many steps can be predicted after so many observed frames; None if any number.

        A model that reads the step index (model.time_input) knows only those that it was trained on.
        """
        features = self.predictor.features
        return features.steps + 1 - frames if features is not None and features.time else None

    def rollout(self, observed: npt.ArrayLike, steps: int, samples: int = 1, seed: int = 0) -> Floats:
        """Sample what the agents do next.

        observed: raw positions (T, N, P) of a group of N agents, or (B, T, N, P) of several, in the units of the data
        that the run was trained on, one frame after the other. The model reads positions and velocities, and a velocity
        is the difference of two frames: so T is at least 2, and the first frame serves for the first velocity only.

        Returns the positions (S, T', N, P) or (S, B, T', N, P) after the last observed frame, for T' = `steps` and S =
        `samples`, in the same units. All agents of a sample are sampled jointly. The same arguments yield the same
        numbers on the same machine. A baseline's samples are all alike.

        Raises InputError if the array has another shape or is not finite, if the model cannot read so many agents, if
        it reads the step index and these are more steps than it was trained on, or if steps, samples and seed are not
        whole numbers.
        """
        steps, samples, seed = _whole("steps", steps), _whole("samples", samples), _whole("seed", seed)
        positions = _numbers(observed)
        if positions.ndim not in (3, 4):
            raise InputError(f"the observed positions need axes (T, N, P) or (B, T, N, P), not {positions.ndim} axes.")
        batch = positions if positions.ndim == 4 else positions[None]
        self._check(batch, steps, samples)
        predicted = self._sample(self._states(batch), steps, samples, seed)
        return predicted if positions.ndim == 4 else predicted[:, 0]

    def _check(self, observed: Floats, steps: int, samples: int) -> None:
        _, frames, agents, axes = observed.shape
        if self.axes not in (None, axes):
            raise InputError(f"the observed positions have {axes} axes P, and the model has {self.axes}.")
        if frames < 2:
            raise InputError("the model needs two observed frames, the first one for the velocity; give one more.")
        if not observed.size:
            raise InputError("there is no agent in the observed positions.")
        if self.agents not in (None, agents):
            raise InputError(
                f"the model tells its {self.agents} agents apart, so it cannot predict {agents}; train with "
                "agent_input=false and standardize=false, or pooled, for other numbers."
            )
        if not np.isfinite(observed).all():
            raise InputError("the observed positions hold NaN or infinite values; leave these windows out.")
        if steps < 1 or samples < 1:
            raise InputError(f"steps and samples are at least 1, not {steps} and {samples}.")
        most = self.most_steps(frames)
        if most is not None and steps > most:
            remedy = f"ask for at most {most} steps" if most > 0 else f"observe at most {frames + most - 1} frames"
            raise InputError(f"the model reads the step index, of which it was trained on so many; {remedy}.")

    def _states(self, observed: Floats) -> torch.Tensor:
        """Return the scaled states (B, T - 1, N, 2P) of positions (B, T, N, P)."""
        velocities = self.scaling.scale_velocities(np.diff(observed, axis=1))
        states = np.concatenate([self.scaling.scale_positions(observed[:, 1:]), velocities], axis=-1)
        if self.predictor.features is None:  # nothing is learned, and nothing rounded
            return torch.as_tensor(states)
        if np.abs(states).max() > largest_scaled(self.spec.environment):
            raise InputError("the observed positions are far from all that the model was trained on; check the units.")
        return torch.as_tensor(states, dtype=torch.float32)

    def _sample(self, states: torch.Tensor, steps: int, samples: int, seed: int) -> Floats:
        """Return raw positions (S, B, T', N, P) that follow the states (B, H, N, 2P)."""
        generator = torch.Generator().manual_seed(seed)
        groups = torch.split(torch.arange(len(states)).repeat(samples), TOGETHER)
        made = [self.predictor.free_run(states[group], steps, generator)[:, 1:] for group in groups]
        scaled = to_numpy(torch.cat(made))[..., : states.shape[-1] // 2]
        positions: Floats = self.scaling.unscale_positions(scaled)
        return positions.reshape(samples, len(states), *positions.shape[1:])


def load_run(
    run: str,
    db: str | Path,
    *,
    model: Model = "best",
    data: str | Path | None = None,
    artifacts: str | None = None,
) -> TrainedRun:
    """Load the trained model of a run.

    run: the id of a run, or its first digits. db: the database, a path or an SQLAlchemy URL, with its checkpoints
    beside it. model: the one with the smallest validation error, or that of the last epoch. data: the expert set that
    the run was trained on; only needed for runs of ssmail 0.1 and earlier on data from a file, which did not store
    their scaling. artifacts: the folder or URL where training kept the checkpoints, by default that of SSMAIL_ARTIFACTS
    if it is set.

    Nothing that the database names is run, imported or opened, except the run's checkpoints in these two places.
    Raises InputError if there is no such run, or if it has no such model.
    """
    if as_url(db).get_backend_name() == "sqlite":
        existing(db)  # opening it would create it
    store = Store.open(db, artifacts=artifacts)
    try:
        return load_from(store, run, model=model, data=data)
    finally:
        store.close()


def load_from(store: Store, run: str, *, model: Model = "best", data: str | Path | None = None) -> TrainedRun:
    """Load the trained model of a run in an open store; see `load_run`."""
    if model not in ("best", "last"):
        raise InputError(f"a run has a best and a last model, not {str(model)!r:.40}; choose one of the two.")
    (row,) = store.runs(ids=[run])
    latest = store.latest_metrics([row.id])
    described, weights, epoch = _stored(store, row, model, data)
    try:
        predictor = described.make(weights)
    except UnfitState as error:
        raise _unfit(row, error) from error
    baseline = described.features is None
    return TrainedRun(
        id=row.id,
        spec_hash=row.spec_hash,
        seed=row.seed,
        dataset_hash=row.dataset_hash,
        spec=described.spec,
        metrics=dict(zip(latest["name"], latest["value"].astype(float), strict=True)),
        model=model,
        epoch=epoch,
        axes=None if baseline else described.state_size // 2,
        agents=described.agents,
        scaling=described.scaling,
        predictor=predictor,
    )


def _stored(store: Store, row: RunRow, model: Model, data: str | Path | None) -> tuple[PredictorSpec, Any, int]:
    """Return what the model of a run is built from, its weights, and its epoch. Raises InputError."""
    spec = _spec(row)
    if spec.model is None and spec.variational is None:  # a baseline has no checkpoint and needs no scaling
        return PredictorSpec(spec, IDENTITY, 2, None), {}, 0
    best = _checkpoint(store, row, BEST)
    try:
        found = PredictorSpec.from_state(best["predictor"]) if "predictor" in best else _refitted(spec, row, data)
        if (found.spec.method, found.spec.environment) != (spec.method, spec.environment):
            raise UnfitState("it is that of another run")
        if model == "best":
            return found, best.get("policy"), _epoch(best)
        last = _checkpoint(store, row, LAST)
        return found, last_weights(found.spec, last), _epoch(last)
    except UnfitState as error:
        raise _unfit(row, error) from error


def _spec(row: RunRow) -> RunSpec:
    """Return the spec of a run. Raises InputError if another version of ssmail wrote it."""
    try:
        return RunSpec.model_validate_json(json.dumps(row.spec))
    except ValidationError:
        raise InputError(
            f"run {row.name} has settings that this ssmail does not know; use the version that trained it, "
            f"{row.package_version:.20}"
        ) from None


def _checkpoint(store: Store, row: RunRow, name: str) -> dict[str, Any]:
    """Return the checkpoint that a run recorded under a name, or left in its folder so far. Raises InputError."""
    where, state = load_recorded(store, row.id, name)
    if state is None:
        raise InputError(
            f"run {row.name} has no model: there is no {where}; train it, copy its checkpoints beside the database, or "
            "give the place that it was trained with as --artifacts"
        )
    return state


def _refitted(spec: RunSpec, row: RunRow, data: str | Path | None) -> PredictorSpec:
    """Fit to the expert set of a run whose checkpoint does not hold what its model is built from.

    Raises InputError if the set comes from a file that is not given, or if it is not that of the run.
    """
    if data is None and spec.data.path is not None:
        raise InputError(
            f"the checkpoint of run {row.name} was written before ssmail stored the scaling in it; give the expert set "
            "that it was trained on with data=FILE (--data FILE)"
        )
    experts = generate(spec.data, row.seed) if data is None else load(Path(data), spec.environment)
    if experts.hash != row.dataset_hash:
        which = "the expert set that its spec generates" if data is None else str(data)
        raise InputError(f"{which} is not what run {row.name} was trained on (its hash differs); give the right file")
    return PredictorSpec.from_data(spec, experts)


def _epoch(checkpoint: Any) -> int:
    epoch: int = fitted_number(checkpoint.get("epoch"), 0, 10**9, "epoch")
    return epoch


def _unfit(row: RunRow, error: UnfitState) -> InputError:
    return InputError(f"the checkpoint of run {row.name} does not fit its run ({error}); train it again")


def _whole(name: str, value: Any) -> int:
    """Return an argument of `rollout` as an int. Raises InputError unless it is a whole number of a usable size."""
    try:
        number = operator.index(value)
    except TypeError:
        raise InputError(f"{name} is a whole number, not {value!r:.40}.") from None
    if not -(2**63) <= number < 2**63:
        raise InputError(f"{name} is a whole number of at most 64 bits, not {number}; give a smaller one.")
    return number


def _numbers(observed: npt.ArrayLike) -> Floats:
    """Return an array of float64. Raises InputError if they are not numbers, or not of one shape."""
    try:
        return np.asarray(observed, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("the observed positions are not an array of numbers.") from None
