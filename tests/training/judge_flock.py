"""How a method does on the flock of tests/data/flock.py: its error beside that of constant velocity, and its goals.

python -m tests.training.judge_flock results/ssmail.db   # every finished run on the flock, best model
"""

import sys
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch

from ssmail.config.spec import RunSpec
from ssmail.store import Store
from ssmail.training.checkpoint import load_checkpoint
from ssmail.training.learner import Predictor
from ssmail.training.loop import TrainingLoop
from tests.data.flock import GOALS, nearer_goal

STEPS = (1, 10, 20, 40)
SAMPLES = 5
KNOWN, OPEN = 50, 15  # observed frames after which every group, and no group, has committed to its goal
REACHED = 15.0  # distance of the middle of a group from a goal that it has reached; the goals are 60 apart


@dataclass(frozen=True)
class Goals:
    """Of sampled forecasts of the test windows: shares that end at a goal, at the rarer one, and at the right one."""

    reached: float
    rarer: float
    right: float


def error_ratios(values: Mapping[str, float], prefix: str = "test") -> dict[int, float]:
    """Return the mse of each of STEPS as a fraction of constant velocity's, from the metrics of a final evaluation."""
    return {h: values[f"{prefix}/mse_{h}"] / values[f"test_constant_velocity/mse_{h}"] for h in STEPS}


def goals(loop: TrainingLoop, predictor: Predictor, observed: int) -> Goals:
    """Forecast every test window from its first `observed` frames to its end, SAMPLES times."""
    states = loop.evaluator.states(loop.data.test)
    given = states[:, :observed].repeat(SAMPLES, 1, 1, 1)
    made = predictor.free_run(given, states.shape[1] - observed, torch.Generator().manual_seed(0))
    ends = loop.evaluator.raw_positions(made[:, -1])
    distance = np.linalg.norm(ends.mean(axis=1)[:, None] - GOALS, axis=-1).min(axis=1)
    chosen, true = nearer_goal(ends), np.tile(nearer_goal(loop.data.test.positions[:, -1]), SAMPLES)
    counts = np.bincount(chosen[distance <= REACHED], minlength=len(GOALS))
    return Goals(float((distance <= REACHED).mean()), float(counts.min() / len(chosen)), float((chosen == true).mean()))


def best_predictor(loop: TrainingLoop) -> Predictor:
    """Return the predictor with the weights of the best epoch."""
    best = deepcopy(loop.learner.predictor)
    best.model.load_state_dict(loop.best["weights"])
    return best


def main() -> None:
    for database in sys.argv[1:]:
        store = Store.open(database)
        for run in store.runs(environment="mocap", state="finished"):
            loop = TrainingLoop(RunSpec.model_validate_json(run.spec_json), run.seed)
            (file,) = (item.path for item in store.artifacts(run.id) if item.name == "best.pt")
            loop.best["weights"] = load_checkpoint(file)["policy"]
            latest = store.latest_metrics([run.id])
            values = dict(zip(latest["name"], latest["value"], strict=True))
            print(f"{run.method} {run.spec_hash[:8]} seed {run.seed}, best epoch {values.get('best_epoch', 0):.0f}")
            for prefix in ("test", "test_mean", "test_last"):
                ratios = ", ".join(f"{ratio:.2f}" for ratio in error_ratios(values, prefix).values())
                print(f"  {prefix}: mse of steps {STEPS} as fractions of constant velocity's: {ratios}")
            for observed in (KNOWN, OPEN):
                print(f"  after {observed} frames: {goals(loop, best_predictor(loop), observed)}")


if __name__ == "__main__":
    main()
