"""What is measured of a predictor after every epoch and at the end, environment by environment."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ssmail.config.sections import required
from ssmail.config.spec import RunSpec
from ssmail.data.letters import first_letter_step
from ssmail.data.trajectories import ExpertSet, Floats, Trajectories
from ssmail.errors import InputError
from ssmail.evaluation.protocol import forecast_metrics, full_metrics, letter_metrics, one_step_mse, quick_metrics
from ssmail.training.experts import as_doubles, scaled_batch
from ssmail.training.learning import Predictor, Setting
from ssmail.training.references import ConstantVelocity, CopyLast

Arrays = dict[str, np.ndarray]


class Evaluator(Protocol):
    """Measures predictors on the splits of an expert set."""

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """The metrics of every epoch, of validation and of some training trajectories."""
        ...

    def rank(self, values: dict[str, float]) -> tuple[bool, float]:
        """How good the epoch with these metrics is: the smallest is the best."""
        ...

    def final(self, best: Predictor, last: Predictor) -> tuple[dict[str, float], Arrays]:
        """The metrics on the test split, and the arrays to draw."""
        ...

    def beginning(self, untrained: Predictor) -> Arrays:
        """The arrays to draw of a predictor before its first epoch; may be none."""
        ...


def make_evaluator(spec: RunSpec, data: ExpertSet, setting: Setting) -> Evaluator:
    """That of the spec's environment."""
    return EVALUATORS[spec.environment](spec, data, setting)


class _Evaluator:
    """What the evaluators of all environments share: the splits as tensors, and draws from their own generator."""

    def __init__(self, spec: RunSpec, data: ExpertSet, setting: Setting) -> None:
        self.spec, self.data, self.setting = spec, data, setting
        self.scaling, self.device = data.scaling, setting.device
        self.generator = setting.generators["evaluation"]
        self.validation_states = scaled_batch(data.validation, self.scaling, self.device).states
        self.reference = ConstantVelocity(setting.integrator)

    def beginning(self, untrained: Predictor) -> Arrays:
        """None."""
        return {}

    def some_training_trajectories(self) -> Tensor:
        """Indices of spec.evaluation.train_rollouts training trajectories, drawn anew in every epoch."""
        count = min(self.spec.evaluation.train_rollouts, len(self.data.train))
        return torch.randperm(len(self.data.train), generator=self.generator)[:count]

    def states(self, trajectories: Trajectories) -> Tensor:
        """Scaled states (B, T, N, D)."""
        return scaled_batch(trajectories, self.scaling, self.device).states

    def one_step(self, predictor: Predictor, states: Tensor) -> float:
        """See evaluation.protocol.one_step_mse."""
        predicted = predictor.one_step(states, self.generator)
        return one_step_mse(predicted.double().cpu().numpy(), states[:, 1:].double().cpu().numpy())

    def raw_positions(self, states: Tensor) -> Floats:
        """Scaled states (..., 2P) -> raw positions (..., P)."""
        raw: Floats = self.scaling.unscale_positions(as_doubles(states[..., : states.shape[-1] // 2]))
        return raw


class LaneEvaluator(_Evaluator):
    """Y-Junction: free-running from the first state, judged by the distance to the nearer lane."""

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """One sampled rollout from every validation start and from some training starts."""
        chosen = self.some_training_trajectories()
        validation, train = self.data.validation, self.data.train[chosen.numpy()]
        trained = self.setting.experts.states[chosen.to(self.device), :1]
        positions = self._free_run(predictor, torch.cat([self.validation_states[:, :1], trained]))
        values: dict[str, float] = {}
        parts = {
            "validation": (positions[: len(validation)], validation),
            "train": (positions[len(validation) :], train),
        }
        for split, (predicted, truth) in parts.items():
            measured = quick_metrics(predicted, truth, self.data.centre_lines, self.scaling)
            values |= {f"{split}/{name}": value for name, value in measured.items()}
        return values

    def rank(self, values: dict[str, float]) -> tuple[bool, float]:
        """The smallest validation mode_mse among the epochs that use every mode.

        The error is the distance to the nearest mode, so by itself it would prefer a model that dropped one.
        """
        error, balance = values["validation/mode_mse"], values["validation/lane_balance"]
        return balance < self.spec.evaluation.least_balance or not math.isfinite(error), error

    def final(self, best: Predictor, last: Predictor) -> tuple[dict[str, float], Arrays]:
        """The model of best validation, sampled and by its mean; the last model; and constant velocity."""
        truth, lines = self.data.test, self.data.centre_lines
        states = self.states(truth)
        sampled = self._samples(best, states)
        candidates = {
            "test": (best, sampled),
            "test_mean": (best, self._samples(best, states, deterministic=True)),
            "test_last": (last, self._samples(last, states)),
            "test_constant_velocity": (self.reference, self._samples(self.reference, states, samples=1)),
        }
        values: dict[str, float] = {}
        for prefix, (predictor, samples) in candidates.items():
            measured = full_metrics(samples, truth, lines, self.scaling)
            measured["one_step_mse"] = self.one_step(predictor, states)
            values |= {f"{prefix}/{name}": value for name, value in measured.items()}
        arrays: Arrays = {
            "test/rollouts": sampled.astype(np.float32),
            "test/expert": truth.positions.astype(np.float32),
            "test/lanes": truth.continuations.astype(np.float32),
            "train/expert": self.data.train.positions.astype(np.float32),
            "train/lane": self.data.train.mode,
            "lane_centres": lines.astype(np.float32),
        }
        return values, arrays

    def _free_run(self, predictor: Predictor, observed: Tensor, deterministic: bool = False) -> Floats:
        """Raw positions (B, T, N, P) of one free-running rollout from each start (B, 1, N, D), the start included."""
        steps = self.setting.steps
        return self.raw_positions(predictor.free_run(observed, steps, self.generator, deterministic=deterministic))

    def _samples(
        self, predictor: Predictor, states: Tensor, deterministic: bool = False, samples: int | None = None
    ) -> Floats:
        """(S, B, T, N, P) raw positions: S rollouts of every start, spec.evaluation.samples by default."""
        s = samples or self.spec.evaluation.samples
        positions = self._free_run(predictor, states[:, :1].repeat(s, 1, 1, 1), deterministic)
        return positions.reshape(s, len(states), *positions.shape[1:])


class LetterEvaluator(_Evaluator):
    """Letters: free-running from the first state, judged by the distance to the letter that was meant."""

    STARTS = 16  # test starts from which the untrained predictor is rolled out

    def __init__(self, spec: RunSpec, data: ExpertSet, setting: Setting) -> None:
        super().__init__(spec, data, setting)
        self.begin = first_letter_step(data.train.positions.shape[1])

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """One sampled rollout from every validation start and from some training starts."""
        trained = self.setting.experts.states[self.some_training_trajectories().to(self.device)]
        truth = torch.cat([self.validation_states, trained])
        made = predictor.free_run(truth[:, :1], self.setting.steps, self.generator)
        values: dict[str, float] = {}
        parts = {"validation": slice(len(self.validation_states)), "train": slice(len(self.validation_states), None)}
        for split, part in parts.items():
            measured = self._measure(made[None, part], truth[part])
            values |= {f"{split}/{name}": value for name, value in measured.items()}
        return values

    def rank(self, values: dict[str, float]) -> tuple[bool, float]:
        """The smallest validation stroke_distance.

        It is what the letters are judged by. The mse also asks for the tempo, and prefers a vague letter in time to a
        clear one that comes late.
        """
        error = values["validation/stroke_distance"]
        return not math.isfinite(error), error

    def final(self, best: Predictor, last: Predictor) -> tuple[dict[str, float], Arrays]:
        """The model of best validation, sampled and by its mean; the last model; constant velocity; the expert."""
        truth = self.states(self.data.test)
        sampled = self._samples(best, truth)
        candidates = {
            "test": sampled,
            "test_mean": self._samples(best, truth, deterministic=True),
            "test_last": self._samples(last, truth),
            "test_constant_velocity": self._samples(self.reference, truth, samples=1),
        }
        values: dict[str, float] = {}
        for prefix, samples in candidates.items():
            measured = self._measure(samples, truth)
            values |= {f"{prefix}/{name}": value for name, value in measured.items()}
        for prefix, predictor in {"test": best, "test_constant_velocity": self.reference}.items():
            values[f"{prefix}/one_step_mse"] = self.one_step(predictor, truth)
        expert = self._measure(truth[None], truth)
        values |= {f"test_expert/{name}": value for name, value in expert.items() if "stroke" in name}
        return values, {
            "test/rollouts": self.raw_positions(sampled).astype(np.float32),
            "test/expert": self.data.test.positions.astype(np.float32),
            "train/expert": self.data.train.positions.astype(np.float32),
            "letters": self.data.centre_lines.astype(np.float32),
            "first_letter_step": np.array([self.begin]),
        }

    def beginning(self, untrained: Predictor) -> Arrays:
        """One sampled rollout, and one by its mean, from each of the first test starts. Nothing is drawn from the
        evaluation's generator.
        """
        starts = self.states(self.data.test)[: self.STARTS, :1]
        made = {}
        for name, deterministic in (("initial", False), ("initial_mean", True)):
            generator = torch.Generator().manual_seed(self.setting.generators.seeds["evaluation"])
            states = untrained.free_run(starts, self.setting.steps, generator, deterministic=deterministic)
            made[f"{name}/rollouts"] = self.raw_positions(states).astype(np.float32)
        return made

    def _samples(
        self, predictor: Predictor, states: Tensor, deterministic: bool = False, samples: int | None = None
    ) -> Tensor:
        """(S, B, T, N, D) scaled states: S rollouts of every start, spec.evaluation.samples by default."""
        s = samples or self.spec.evaluation.samples
        starts = states[:, :1].repeat(s, 1, 1, 1)
        made = predictor.free_run(starts, self.setting.steps, self.generator, deterministic=deterministic)
        return made.reshape(s, *states.shape)

    def _measure(self, predicted: Tensor, truth: Tensor) -> dict[str, float]:
        return letter_metrics(
            as_doubles(predicted), as_doubles(truth), self.data.centre_lines, self.begin, self.scaling
        )


class ForecastEvaluator(_Evaluator):
    """Recorded motion: some frames are observed, the following ones predicted, with and without noise on what is read
    (section 4.6; the windows are those of DNRI's protocol). Raises InputError when the test windows are too short.
    """

    KEPT = 4  # test windows whose predictions are stored as trajectories

    def __init__(self, spec: RunSpec, data: ExpertSet, setting: Setting) -> None:
        super().__init__(spec, data, setting)
        self.forecast = required(spec.forecast)
        self._check_windows()

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """One sampled rollout of each validation window from its first frame, and of some training windows."""
        trained = self.setting.experts.states[self.some_training_trajectories().to(self.device)]
        values: dict[str, float] = {}
        for split, truth in {"validation": self.validation_states, "train": trained}.items():
            predicted = predictor.free_run(truth[:, :1], truth.shape[1] - 1, self.generator)
            measured, _ = forecast_metrics(as_doubles(predicted[None, :, 1:]), as_doubles(truth[:, 1:]), self.scaling)
            values |= {f"{split}/{name}": value for name, value in measured.items()}
        return values

    def rank(self, values: dict[str, float]) -> tuple[bool, float]:
        """The smallest validation mse, over all predicted steps."""
        error = values["validation/mse"]
        return not math.isfinite(error), error

    def final(self, best: Predictor, last: Predictor) -> tuple[dict[str, float], Arrays]:
        """The model of best validation, clean and noisy, sampled and by its mean; the last model; the references."""
        states = self.states(self.data.test)
        candidates = {
            "test": (best, False, False),
            "test_noisy": (best, False, True),
            "test_mean": (best, True, False),
            "test_mean_noisy": (best, True, True),
            "test_last": (last, False, False),
            "test_constant_velocity": (self.reference, True, False),
            "test_constant_velocity_noisy": (self.reference, True, True),
            "test_copy_last": (CopyLast(), True, False),
            "test_copy_last_noisy": (CopyLast(), True, True),
        }
        values: dict[str, float] = {}
        arrays: Arrays = {}
        for prefix, (predictor, deterministic, noisy) in candidates.items():
            predicted, truth = self._predict(predictor, states, deterministic, noisy)
            measured, curves = forecast_metrics(predicted, truth, self.scaling)
            values |= {f"{prefix}/{name}": value for name, value in measured.items()}
            arrays |= {f"{prefix}/{name}": curve for name, curve in curves.items()}
            if prefix in ("test", "test_noisy"):
                arrays[f"{prefix}/predictions"] = self._positions(predicted[:1])
        for prefix, predictor in {"test": best, "test_constant_velocity": self.reference}.items():
            values[f"{prefix}/one_step_mse"] = self.one_step(predictor, states)
        arrays["test/expert"] = self._positions(truth[None])
        return values, arrays

    def _check_windows(self) -> None:
        observed, predicted = self.forecast.observed, self.forecast.predicted
        frames = self.data.test.positions.shape[1]
        if observed + predicted > frames:
            raise InputError(
                f"forecast.observed {observed} and forecast.predicted {predicted} need {observed + predicted} frames, "
                f"but the test windows of the data have {frames}; lower one of the two with --set."
            )

    def _positions(self, states: Floats) -> np.ndarray:
        """Raw positions of the first KEPT windows of (1, B, T, N, D) scaled states."""
        scaled = states[0, : self.KEPT, ..., : states.shape[-1] // 2]
        raw: np.ndarray = self.scaling.unscale_positions(scaled).astype(np.float32)
        return raw

    def _predict(self, predictor: Predictor, states: Tensor, deterministic: bool, noisy: bool) -> tuple[Floats, Floats]:
        """(S, B, T', N, D) predictions of the frames after the observed ones, and the truth (B, T', N, D)."""
        h, steps, b = self.forecast.observed, self.forecast.predicted, len(states)
        always_the_same = isinstance(predictor, (ConstantVelocity, CopyLast)) and not noisy
        samples = 1 if always_the_same else self.spec.evaluation.samples
        observed = states[:, :h].repeat(samples, 1, 1, 1)
        noise = self._noise(observed, steps) if noisy else None
        predicted = predictor.free_run(observed, steps, self.generator, deterministic=deterministic, noise=noise)
        made = as_doubles(predicted[:, 1:]).reshape(samples, b, steps, *states.shape[2:])
        return made, as_doubles(states[:, h : h + steps])

    def _noise(self, observed: Tensor, steps: int) -> Tensor:
        """The noise on every state that is read, the same for all methods and seeds."""
        generator = torch.Generator().manual_seed(self.forecast.noise_seed)
        b, h, n, d = observed.shape
        noise = self.forecast.noise * torch.randn(b, h + steps - 1, n, d, generator=generator)
        if self.forecast.noise_on == "history":
            noise[:, h:] = 0
        return noise.to(self.device)


EVALUATORS: dict[str, Callable[[RunSpec, ExpertSet, Setting], Evaluator]] = {
    "yjunction": LaneEvaluator,
    "letters": LetterEvaluator,
    "mocap": ForecastEvaluator,
}
