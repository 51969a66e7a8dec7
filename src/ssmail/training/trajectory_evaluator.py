"""Evaluation on own trajectories: forecasts of windows with any number of agents."""

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np
from torch import Tensor

from ssmail.config.sections import required
from ssmail.data.trajectories import ExpertSet, Floats, Integers, Trajectories
from ssmail.evaluation.forecasts import MeasuredForecasts, measure, summarize
from ssmail.training.agent_numbers import windows_by_number, with_agents
from ssmail.training.baselines import Baseline, CopyLast
from ssmail.training.batches import Arrays, Batch, to_numpy
from ssmail.training.evaluators import Evaluator, check_frames, input_noise
from ssmail.training.learner import LearnerContext, Predictor, Reading

PAIRS = 2**16  # pairs of agents whose forecasts are made at once; on a network of the largest profile, some 2 GB


class TrajectoryEvaluator(Evaluator):
    """Own trajectories: observe some frames of a window and predict the following ones, several times.

    Each window counts the same, whatever its number of agents.
    """

    # The mean squared error of where the future is open is least for a model that guesses the middle.
    selected_by: ClassVar[str] = "validation/energy"
    KEPT_WINDOWS = 6  # test windows whose forecasts are stored
    OF_EPOCHS = ("mse", "mse_last", "ade", "fde", "energy", "min_fde_5", "diverged")  # the metrics of every epoch

    def __init__(self, context: LearnerContext, data: ExpertSet) -> None:
        self.forecast = required(context.spec.forecast)
        self.observed, self.predicted = check_frames(self.forecast, data)
        super().__init__(context, data)
        self.validation = data.validation[_evenly(len(data.validation), self.spec.validation_windows)]
        self.tested = _evenly(len(data.test), self.spec.test_windows)
        self.test = data.test[self.tested]

    def epoch(self, predictor: Predictor) -> dict[str, float]:
        """Forecast validation windows evaluation.validation_samples times, and some training windows once.

        The training windows have the most common number of agents: each further number costs as many steps again.
        """
        common = next(iter(windows_by_number(self.data.train).values()))
        train = self.data.train[common[self.draw_training().numpy()]]
        values: dict[str, float] = {}
        for split, windows, samples in (
            ("validation", self.validation, self.spec.validation_samples or 1),
            ("train", train, 1),
        ):
            measured, _ = self._measured(predictor, windows, samples)
            values |= {f"{split}/{name}": measured[name] for name in self.OF_EPOCHS if name in measured}
        return values

    def final(self, best: Predictor, last: Predictor, untrained: Predictor) -> tuple[dict[str, float], Arrays]:
        """Evaluate the best model, sampled and by its mean actions, the last one, and the baselines.

        With forecast.noise all but the last model also with noise on what they read.
        """
        predictors = {  # predictor, deterministic
            "test": (best, False),
            "test_mean": (best, True),
            "test_last": (last, False),
            "test_constant_velocity": (self.constant_velocity, True),
            "test_copy_last": (CopyLast(), True),
        }
        candidates = [(name, predictor, mean, False) for name, (predictor, mean) in predictors.items()]
        if self.forecast.noise:
            noisy = [name for name in predictors if name != "test_last"]
            candidates += [(f"{name}_noisy", *predictors[name], True) for name in noisy]
        values: dict[str, float] = {}
        arrays = self._kept_truth()
        for prefix, predictor, deterministic, noise in candidates:
            keep = arrays["test/samples"] if prefix == "test" else None
            measured, curves = self._measured(predictor, self.test, self.spec.samples, deterministic, noise, keep)
            values |= {f"{prefix}/{name}": value for name, value in measured.items()}
            arrays |= {f"{prefix}/{name}": curve for name, curve in curves.items()}
        for prefix, predictor in {"test": best, "test_constant_velocity": self.constant_velocity}.items():
            values[f"{prefix}/one_step_mse"] = self._one_step_mse(predictor)
        return values | self._expert_values(), arrays

    def _measured(
        self,
        predictor: Predictor,
        windows: Trajectories,
        samples: int,
        deterministic: bool = False,
        noisy: bool = False,
        keep: np.ndarray | None = None,
    ) -> tuple[dict[str, float], Mapping[str, Floats]]:
        """Forecast windows and return their metrics and curves.

        keep: (S, W, T', N, P), to be filled with the forecasts of the kept test windows. Those of a baseline are the
        same for all S.
        """
        made = 1 if isinstance(predictor, Baseline) and not noisy else samples
        parts, kept, h = [], self._kept().tolist(), self.observed
        for index, states in self._chunks(windows, made):
            given, reading = states[:, :h], Reading(deterministic=deterministic, samples=made)
            if noisy:  # every sample has noise of its own on what it observes
                given = given.repeat(made, 1, 1, 1)
                reading |= {"samples": 1, "noise": input_noise(self.forecast, given, self.predicted)}
            states_made = predictor.free_run(given, self.predicted, self.generator, **reading)
            predicted = to_numpy(states_made[:, 1:]).reshape(made, len(index), self.predicted, *states.shape[2:])
            true = to_numpy(states)
            truth = true[:, h : h + self.predicted]
            parts.append(measure(predicted, truth, true[:, h - 1], self.scaling, self.forecast, samples))
            for b, window in enumerate(index.tolist() if keep is not None else ()):
                if keep is not None and window in kept:
                    positions = self.scaling.unscale_positions(predicted[:, b, ..., : states.shape[-1] // 2])
                    keep[:, kept.index(window), :, : states.shape[2]] = positions
        return summarize(MeasuredForecasts.join(parts))

    def _chunks(self, windows: Trajectories, times: int) -> Iterator[tuple[Integers, Tensor]]:
        """Yield the indices of some windows with equally many agents, and their scaled states (B, T, N, D).

        `times` so many pairs of agents as they have are PAIRS at most, unless a single window has more.
        """
        for agents, index in windows_by_number(windows).items():
            count = max(1, PAIRS // (times * agents**2))
            for first in range(0, len(index), count):
                part = index[first : first + count]
                yield (
                    part,
                    Batch.from_trajectories(with_agents(windows, part, agents), self.scaling, self.device).states,
                )

    def _one_step_mse(self, predictor: Predictor) -> float:
        """Return the mean squared error of one-step predictions of the test windows, in scaled units."""
        total = 0.0
        for index, states in self._chunks(self.test, self.test.positions.shape[1]):
            total += len(index) * self.one_step(predictor, states)
        return total / len(self.test)

    def _expert_values(self) -> dict[str, float]:
        """Return what the true futures of the test windows have in common with forecasts: their collisions."""
        if self.forecast.collision_distance is None:
            return {}
        h, shares = self.observed, []
        for _, states in self._chunks(self.test, 1):
            truth = to_numpy(states)
            future, last = truth[:, h : h + self.predicted], truth[:, h - 1]
            shares.append(measure(future[None], future, last, self.scaling, self.forecast, 1).windows["collisions"])
        return {"test_expert/collisions": float(np.concatenate(shares).mean())}

    def _kept(self) -> Integers:
        return _evenly(len(self.test), self.KEPT_WINDOWS)

    def _kept_truth(self) -> Arrays:
        """Return the arrays of the kept test windows, in raw units; their samples are still to be made.

        test/window is their index in the test split. test/scene has the bytes of their scenes' names, with zeros up to
        the longest, and test/frame the first frame of each.
        """
        kept, h = self._kept(), self.observed
        test = self.test[kept]
        positions = test.positions[:, : h + self.predicted].astype(np.float32)
        agents = np.full(len(test), positions.shape[2]) if test.agents is None else test.agents
        arrays = {
            "test/observed": positions[:, :h],
            "test/future": positions[:, h:],
            "test/samples": np.zeros((self.spec.samples, *positions[:, h:].shape), np.float32),
            "test/agents": agents,
            "test/window": self.tested[kept],
        }
        if test.scene is not None and test.frame is not None:
            names = np.array([self.data.scenes[scene].encode() for scene in test.scene])
            arrays |= {"test/scene": names.view(np.uint8).reshape(len(test), -1), "test/frame": test.frame}
        return arrays


def _evenly(length: int, count: int | None) -> Integers:
    """Return up to `count` indices, evenly from 0 to length - 1; None: all."""
    return np.linspace(0, length - 1, min(count or length, length)).round().astype(np.int64)
