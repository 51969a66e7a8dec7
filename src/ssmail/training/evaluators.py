"""Evaluation of a predictor after every epoch and at the end of training: one evaluator per environment."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ssmail.config.sections import ForecastSpec, required
from ssmail.data.letters import first_letter_step
from ssmail.data.trajectories import ExpertSet, Floats, Trajectories
from ssmail.errors import InputError
from ssmail.evaluation.metrics import (
    forecast_metrics,
    lane_metrics,
    lane_test_metrics,
    letter_metrics,
    one_step_mse,
    turning,
)
from ssmail.training.baselines import Baseline, ConstantVelocity, CopyLast
from ssmail.training.batches import Arrays, Batch, to_numpy
from ssmail.training.data_defaults import forecast_frames
from ssmail.training.learner import LearnerContext, Predictor


class Evaluator(ABC):
    """Measures predictors on the splits of an expert set. It draws from the evaluation generator only."""

    selected_by: ClassVar[str]
    """The metric of an epoch that selects the best model: the smaller, the better."""

    def __init__(self, context: LearnerContext, data: ExpertSet) -> None:
        self.context, self.data, self.spec = context, data, context.spec.evaluation
        self.scaling, self.device, self.steps = data.scaling, context.device, context.steps
        self.generator = context.generators["evaluation"]
        self.validation_states = self.states(data.validation)
        self.constant_velocity = ConstantVelocity(context.integrator)

    @abstractmethod
    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """Return the metrics of an epoch, on the validation split and on some training trajectories."""

    def rank(self, values: Mapping[str, float]) -> tuple[bool, float]:
        """Return (flawed, error) of the epoch with these metrics. The epoch with the smallest pair is the best."""
        error = values[self.selected_by]
        return not math.isfinite(error), error

    @abstractmethod
    def final(self, best: Predictor, last: Predictor, untrained: Predictor) -> tuple[dict[str, float], Arrays]:
        """Return the metrics on the test split, and the arrays to draw.

        best: the model with the best validation error. last: the model after the last epoch. untrained: the model
        before the first one.
        """

    def states(self, trajectories: Trajectories) -> Tensor:
        """Return scaled states (B, T, N, D)."""
        return Batch.from_trajectories(trajectories, self.scaling, self.device).states

    def raw_positions(self, states: Tensor) -> Floats:
        """Convert scaled states (..., 2P) to raw positions (..., P)."""
        raw: Floats = self.scaling.unscale_positions(to_numpy(states[..., : states.shape[-1] // 2]))
        return raw

    def draw_training(self) -> Tensor:
        """Draw the indices in `experts` of evaluation.train_rollouts training trajectories, anew in every epoch."""
        count = min(self.spec.train_rollouts, len(self.context.experts))
        return torch.randperm(len(self.context.experts), generator=self.generator)[:count]

    def sample(
        self, predictor: Predictor, states: Tensor, deterministic: bool = False, samples: int | None = None
    ) -> Tensor:
        """Roll out from the first of the scaled states (B, T, N, D): (S, B, T, N, D).

        S is `samples`, or evaluation.samples by default.
        """
        s = samples or self.spec.samples
        starts = states[:, :1].repeat(s, 1, 1, 1)
        made = predictor.free_run(starts, self.steps, self.generator, deterministic=deterministic)
        return made.reshape(s, *states.shape)

    def one_step(self, predictor: Predictor, states: Tensor) -> float:
        """Return the mean squared error of one-step predictions of states (B, T, N, D), in scaled units."""
        predicted = predictor.one_step(states, self.generator)
        return one_step_mse(to_numpy(predicted), to_numpy(states[:, 1:]))


class LaneEvaluator(Evaluator):
    """Y-Junction: rollouts from the first state, measured by the distance to the nearer lane."""

    selected_by = "validation/mode_mse"

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """Roll out once from every validation start and from some training starts.

        The validation split has the values of `turning` too, in epochs in which enough groups turn.
        """
        chosen = self.draw_training()
        trained = self.context.experts.states[chosen.to(self.device), :1]
        starts = torch.cat([self.validation_states[:, :1], trained])
        positions = self.raw_positions(predictor.free_run(starts, self.steps, self.generator))
        count, lines = len(self.data.validation), self.data.centre_lines
        validation, train = self.data.validation.continuations, self.data.train[chosen.numpy()].continuations
        turned = turning(positions[:count], validation)
        return {
            **_prefixed("validation", lane_metrics(positions[:count], validation, lines, self.scaling)),
            **_prefixed("validation", {name: value for name, value in turned.items() if math.isfinite(value)}),
            **_prefixed("train", lane_metrics(positions[count:], train, lines, self.scaling)),
        }

    def rank(self, values: Mapping[str, float]) -> tuple[bool, float]:
        """Rank epochs that use every mode before all others.

        mode_mse is the distance to the nearest mode; by itself it would favor a model that has dropped one.
        """
        flawed, error = super().rank(values)
        return flawed or values["validation/lane_balance"] < self.spec.least_balance, error

    def final(self, best: Predictor, last: Predictor, untrained: Predictor) -> tuple[dict[str, float], Arrays]:
        """Evaluate the best model, sampled and by its mean actions, the last model, and constant velocity."""
        truth, lines = self.data.test, self.data.centre_lines
        states = self.states(truth)
        sampled = self.sample(best, states)
        candidates = {
            "test": (best, sampled),
            "test_mean": (best, self.sample(best, states, deterministic=True)),
            "test_last": (last, self.sample(last, states)),
            "test_constant_velocity": (self.constant_velocity, self.sample(self.constant_velocity, states, samples=1)),
        }
        values: dict[str, float] = {}
        for prefix, (predictor, samples) in candidates.items():
            measured = lane_test_metrics(self.raw_positions(samples), truth, lines, self.scaling)
            values |= _prefixed(prefix, {**measured, "one_step_mse": self.one_step(predictor, states)})
        return values, {
            "test/rollouts": self.raw_positions(sampled).astype(np.float32),
            "test/expert": truth.positions.astype(np.float32),
            "test/lanes": truth.continuations.astype(np.float32),
            "train/expert": self.data.train.positions.astype(np.float32),
            "train/lane": self.data.train.mode,
            "lane_centres": lines.astype(np.float32),
        }


class LetterEvaluator(Evaluator):
    """Letters: rollouts from the first state, measured by the distance to each agent's letter."""

    # The mse also depends on the tempo, and prefers a vague letter in time to a clear one that comes late.
    selected_by = "validation/stroke_distance"
    UNTRAINED_STARTS = 16  # test starts from which the untrained model is rolled out

    def __init__(self, context: LearnerContext, data: ExpertSet) -> None:
        super().__init__(context, data)
        self.first_letter_step = first_letter_step(data.train.positions.shape[1])

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """Roll out once from every validation start and from some training starts."""
        trained = self.context.experts.states[self.draw_training().to(self.device)]
        truth = torch.cat([self.validation_states, trained])
        made, count = self.sample(predictor, truth, samples=1), len(self.validation_states)
        return {
            **_prefixed("validation", self._measure(made[:, :count], truth[:count])),
            **_prefixed("train", self._measure(made[:, count:], truth[count:])),
        }

    def final(self, best: Predictor, last: Predictor, untrained: Predictor) -> tuple[dict[str, float], Arrays]:
        """Evaluate the best model, sampled and by its mean actions, the last model, constant velocity, and the expert.

        The arrays also hold rollouts of the untrained model.
        """
        truth = self.states(self.data.test)
        sampled = self.sample(best, truth)
        candidates = {
            "test": sampled,
            "test_mean": self.sample(best, truth, deterministic=True),
            "test_last": self.sample(last, truth),
            "test_constant_velocity": self.sample(self.constant_velocity, truth, samples=1),
        }
        values: dict[str, float] = {}
        for prefix, samples in candidates.items():
            values |= _prefixed(prefix, self._measure(samples, truth))
        for prefix, predictor in {"test": best, "test_constant_velocity": self.constant_velocity}.items():
            values[f"{prefix}/one_step_mse"] = self.one_step(predictor, truth)
        expert = self._measure(truth[None], truth)
        values |= _prefixed("test_expert", {name: value for name, value in expert.items() if "stroke" in name})
        return values, {
            "test/rollouts": self.raw_positions(sampled).astype(np.float32),
            "test/expert": self.data.test.positions.astype(np.float32),
            "train/expert": self.data.train.positions.astype(np.float32),
            "letters": self.data.centre_lines.astype(np.float32),
            "first_letter_step": np.array([self.first_letter_step]),
            **self._untrained_rollouts(untrained, truth),
        }

    def _untrained_rollouts(self, untrained: Predictor, truth: Tensor) -> Arrays:
        """Roll out from the first test starts, sampled and by mean actions, with a generator of their own."""
        arrays: Arrays = {}
        for name, deterministic in (("initial", False), ("initial_mean", True)):
            generator = torch.Generator().manual_seed(self.context.generators.seeds["evaluation"])
            starts = truth[: self.UNTRAINED_STARTS, :1]
            states = untrained.free_run(starts, self.steps, generator, deterministic=deterministic)
            arrays[f"{name}/rollouts"] = self.raw_positions(states).astype(np.float32)
        return arrays

    def _measure(self, predicted: Tensor, truth: Tensor) -> dict[str, float]:
        """Return the letter metrics of scaled states (S, B, T, N, D) against truth (B, T, N, D)."""
        letters, begin = self.data.centre_lines, self.first_letter_step
        return letter_metrics(to_numpy(predicted), to_numpy(truth), letters, begin, self.scaling)


class ForecastEvaluator(Evaluator):
    """Recorded motion: observe some frames and predict the following ones, with and without noise on the input.

    Section 4.6; the windows follow DNRI's protocol. Raises InputError if the test windows are too short.
    """

    selected_by = "validation/mse"
    KEPT_WINDOWS = 4  # test windows whose predictions are stored

    def __init__(self, context: LearnerContext, data: ExpertSet) -> None:
        super().__init__(context, data)
        self.forecast = required(context.spec.forecast)
        self.observed, self.predicted = check_frames(self.forecast, data)

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """Predict each validation window from its first frame, and some training windows, once."""
        trained = self.context.experts.states[self.draw_training().to(self.device)]
        values: dict[str, float] = {}
        for split, truth in {"validation": self.validation_states, "train": trained}.items():
            predicted = predictor.free_run(truth[:, :1], truth.shape[1] - 1, self.generator)
            measured, _ = forecast_metrics(to_numpy(predicted[None, :, 1:]), to_numpy(truth[:, 1:]), self.scaling)
            values |= _prefixed(split, measured)
        return values

    def final(self, best: Predictor, last: Predictor, untrained: Predictor) -> tuple[dict[str, float], Arrays]:
        """Evaluate the best model, clean and noisy, sampled and by its mean; the last model; the baselines."""
        states, given = self.states(self.data.test), self.forecast
        history, predictions = (given.model_copy(update={"noise_on": on}) for on in ("history", "predictions"))
        candidates: dict[str, tuple[Predictor, bool, ForecastSpec | None]] = {  # predictor, deterministic, its noise
            "test": (best, False, None),
            "test_noisy": (best, False, given),
            "test_mean": (best, True, None),
            "test_mean_noisy": (best, True, given),
            "test_last": (last, False, None),
            "test_constant_velocity": (self.constant_velocity, True, None),
            "test_constant_velocity_noisy": (self.constant_velocity, True, given),
            "test_copy_last": (CopyLast(), True, None),
            "test_copy_last_noisy": (CopyLast(), True, given),
            "test_noisy_history": (best, False, history),
            "test_noisy_predictions": (best, False, predictions),
        }
        values: dict[str, float] = {}
        arrays: Arrays = {}
        for prefix, (predictor, deterministic, noise_of) in candidates.items():
            predicted, truth = self._predict(predictor, states, deterministic, noise_of)
            measured, curves = forecast_metrics(predicted, truth, self.scaling)
            values |= _prefixed(prefix, measured)
            arrays |= {f"{prefix}/{name}": curve for name, curve in curves.items()}
            if prefix in ("test", "test_noisy"):
                arrays[f"{prefix}/predictions"] = self._kept_positions(predicted[0])
        for prefix, predictor in {"test": best, "test_constant_velocity": self.constant_velocity}.items():
            values[f"{prefix}/one_step_mse"] = self.one_step(predictor, states)
        arrays["test/expert"] = self._kept_positions(truth)
        return values, arrays

    def _kept_positions(self, states: Floats) -> np.ndarray:
        """Return raw positions of the first KEPT_WINDOWS windows of scaled states (B, T, N, D)."""
        scaled = states[: self.KEPT_WINDOWS, ..., : states.shape[-1] // 2]
        raw: np.ndarray = self.scaling.unscale_positions(scaled).astype(np.float32)
        return raw

    def _predict(
        self, predictor: Predictor, states: Tensor, deterministic: bool, noise_of: ForecastSpec | None
    ) -> tuple[Floats, Floats]:
        """Return predictions (S, B, T', N, D) of the frames after the observed ones, and the truth (B, T', N, D)."""
        h, steps, b = self.observed, self.predicted, len(states)
        samples = 1 if isinstance(predictor, Baseline) and not noise_of else self.spec.samples
        observed = states[:, :h].repeat(samples, 1, 1, 1)
        noise = input_noise(noise_of, observed, steps) if noise_of else None
        predicted = predictor.free_run(observed, steps, self.generator, deterministic=deterministic, noise=noise)
        made = to_numpy(predicted[:, 1:]).reshape(samples, b, steps, *states.shape[2:])
        return made, to_numpy(states[:, h : h + steps])


def check_frames(forecast: ForecastSpec, data: ExpertSet) -> tuple[int, int]:
    """Return how many frames are observed and predicted. Raises InputError if the test windows are too short."""
    observed, predicted = forecast_frames(forecast, data)
    frames = data.test.positions.shape[1]
    if observed + predicted > frames:
        raise InputError(
            f"forecast.observed {observed} and forecast.predicted {predicted} need {observed + predicted} frames, "
            f"but the test windows of the data have {frames}; lower one of the two with --set."
        )
    return observed, predicted


def input_noise(forecast: ForecastSpec, observed: Tensor, steps: int) -> Tensor:
    """Draw the noise on the states that a predictor reads: the same for all methods and seeds.

    observed: (B, H, N, D). The noise is (B, H + steps - 1, N, D).
    """
    generator = torch.Generator().manual_seed(forecast.noise_seed)
    b, h, n, d = observed.shape
    noise = forecast.noise * torch.randn(b, h + steps - 1, n, d, generator=generator)
    if forecast.noise_on == "history":
        noise[:, h:] = 0
    if forecast.noise_on == "predictions":
        noise[:, :h] = 0
    return noise.to(observed.device)


def _prefixed(prefix: str, values: Mapping[str, float]) -> dict[str, float]:
    return {f"{prefix}/{name}": value for name, value in values.items()}
