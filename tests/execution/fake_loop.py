"""Training loops that do nothing but what a test needs; tests.execution.fake_worker runs them in worker processes."""

import math
import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssmail.config.spec import RunSpec
from ssmail.errors import InputError
from ssmail.training.loop import Divergence


class Walk:
    """A random walk with the interface of TrainingLoop: its numbers depend on every epoch before."""

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        self.dataset_hash = "d" * 64
        self.epoch, self.improved, self.seed = 0, False, seed
        self.snapshot: dict[str, np.ndarray] = {}
        self.generator = torch.Generator().manual_seed(seed)
        self.place = torch.zeros(3)
        self.best_error, self.best_place = math.inf, self.place

    def run_epoch(self) -> dict[str, float]:
        self.place = self.place + torch.randn(3, generator=self.generator)
        self.epoch += 1
        error = float(self.place.abs().sum())
        self.improved = error < self.best_error
        if self.improved:
            self.best_error, self.best_place = error, self.place
        return {"validation/mode_mse": error, "actor/loss": math.nan if self.epoch == 2 else float(self.place[0])}

    @staticmethod
    def run_epochs(loops: "Sequence[Walk]") -> "list[dict[str, float] | Exception]":
        outcomes: list[dict[str, float] | Exception] = []
        for loop in loops:
            try:
                outcomes.append(loop.run_epoch())
            except Exception as error:
                outcomes.append(error)
        return outcomes

    def state_dict(self) -> dict[str, Any]:
        best = {"error": self.best_error, "place": self.best_place}
        return {"epoch": self.epoch, "generator": self.generator.get_state(), "place": self.place, "best": best}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.epoch, self.place = state["epoch"], state["place"]
        self.best_error, self.best_place = state["best"]["error"], state["best"]["place"]
        self.generator.set_state(state["generator"])

    def best_state_dict(self) -> dict[str, Any]:
        return {"place": self.best_place}

    def final_evaluation(self) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        drawn = torch.randn(2, generator=self.generator)
        return {"test/mode_mse": float(self.best_place.sum() + drawn[0])}, {"test/rollouts": drawn.numpy()}


class Driver(Walk):
    """With the metric that figure 4 draws."""

    def run_epoch(self) -> dict[str, float]:
        found = super().run_epoch()
        return {**found, "train/mode_mse": 2 * found["validation/mode_mse"]}


class OtherData(Walk):
    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        super().__init__(spec, seed, device)
        self.dataset_hash = "e" * 64


class Crashes(Walk):
    """Seed 1 fails in its second epoch."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == 1 and self.seed == 1:
            raise ZeroDivisionError("planted")
        return super().run_epoch()


class Accidents(Crashes):
    """In their second epochs seed 2 is killed, as by the kernel for want of memory, and seed 3 just leaves."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == 1 and self.seed == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.epoch == 1 and self.seed == 3:
            print("out of luck", file=sys.stderr, flush=True)
            os._exit(7)
        return super().run_epoch()


class Diverges(Walk):
    """In its third epoch."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == 2:
            raise Divergence("weights became NaN or infinite in epoch 3")
        return super().run_epoch()


def wait_until_asked_to_stop() -> None:
    """Return shortly after the other end of stdin is closed, which is how a worker is asked to stop."""
    poll = select.poll()
    poll.register(0, 0)
    poll.poll(60_000)
    time.sleep(0.3)  # the thread that waits for the same has noticed by now


class Patient(Walk):
    """In its second epoch it waits until it is asked to stop."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == 1:
            wait_until_asked_to_stop()
        return super().run_epoch()


class PatientSeed(Patient):
    """Seed 3 alone waits."""

    def run_epoch(self) -> dict[str, float]:
        return super().run_epoch() if self.seed == 3 else Walk.run_epoch(self)


class Endless(Walk):
    """An epoch that takes longer than anyone waits."""

    def run_epoch(self) -> dict[str, float]:
        time.sleep(600)
        return super().run_epoch()


class Chatty(Walk):
    """Prints where the events go, says how many threads it has, and whether it meets the process of the other seed."""

    def run_epoch(self) -> dict[str, float]:
        print('{"kind": "finished"}', flush=True)
        print("to stderr", file=sys.stderr)
        return {**super().run_epoch(), "threads": torch.get_num_threads(), "met": self.meet()}

    def meet(self) -> bool:
        place, deadline = Path(os.environ["MEETING_PLACE"]), time.monotonic() + 120
        (place / f"seed {self.seed}").touch()
        while not (place / f"seed {1 - self.seed}").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        return (place / f"seed {1 - self.seed}").exists()


class Slow(Walk):
    """Seed 0 takes a second for each epoch."""

    def run_epoch(self) -> dict[str, float]:
        if self.seed == 0:
            time.sleep(1)
        return super().run_epoch()


class Stuck(Walk):
    """Its second epoch takes longer than anyone waits."""

    def run_epoch(self) -> dict[str, float]:
        if self.epoch == 1:
            time.sleep(600)
        return super().run_epoch()


class Unsteady(Walk):
    """Cannot even begin."""

    def __init__(self, spec: RunSpec, seed: int, device: str = "cpu") -> None:
        raise InputError("planted: no such data")
