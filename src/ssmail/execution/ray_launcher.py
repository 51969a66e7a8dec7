"""Tasks of a Ray cluster, through Ray's own API."""

import logging
import os
import re
import socket
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

import ray

from ssmail.errors import InputError, masked, shortened, unknown_name
from ssmail.execution.launchers import FAILED, INTERRUPTED, Ended, compute, whole, wrong_setting

AUTO = "auto"
"""The address of the cluster that RAY_ADDRESS names, or to which this machine belongs."""
RETRIES = 10
"""How often a task is begun again on another node because its node died, by default."""
SETTINGS = ("address", "cpus", "gpus", "memory", "retries")
_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30}


class RayLauncher:
    """Submits tasks with these settings to a running cluster."""

    def __init__(self, settings: Mapping[str, str], processes: int) -> None:
        given = options(settings, processes)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        address = settings.get("address", AUTO)
        if address == AUTO:
            address = os.environ.get("RAY_ADDRESS") or AUTO
        try:
            _require_listener(address)
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(
                f"--launcher ray cannot reach a Ray cluster at address={shortened(address, 60)} ("
                f"{shortened(_first_line(error), 80)}); start one with `ray start --head`, or give another "
                "--launcher-set address="
            ) from None
        self._redirected = redirect_stdout(sys.stderr)  # Ray prints the logs of nodes that die; stdout is for results
        self._redirected.__enter__()
        self._compute = ray.remote(**given)(compute)
        self._tasks: dict[Any, str] = {}  # names by reference
        self._submitted = 0

    def submit(self, jobs: Sequence[str]) -> list[str]:
        """Submit a task for each job."""
        names = []
        for job in jobs:
            names.append(f"task {self._submitted}")
            self._tasks[self._compute.remote(job)] = names[-1]
            self._submitted += 1
        return names

    def poll(self) -> list[Ended]:
        """Return the results of the tasks that are ready."""
        waiting = list(self._tasks)
        ready, _ = ray.wait(waiting, num_returns=len(waiting), timeout=0) if waiting else ([], [])
        return [self._result(task, self._tasks.pop(task)) for task in ready]

    def cancel(self) -> None:
        """Cancel the tasks: Ray interrupts those that run, as Ctrl-C does."""
        for task in self._tasks:
            ray.cancel(task)

    def close(self) -> None:
        """Leave the cluster, which ends the tasks that are left."""
        ray.shutdown()
        self._redirected.__exit__(None, None, None)

    def _result(self, task: Any, name: str) -> Ended:
        try:
            return Ended(name, ray.get(task))
        except ray.exceptions.TaskCancelledError:
            return Ended(name, None, INTERRUPTED, "its Ray task was cancelled")
        except ray.exceptions.RayError as error:
            return Ended(name, None, FAILED, f"its Ray task ended: {type(error).__name__}: {_first_line(error)}")


def options(settings: Mapping[str, str], processes: int = 1) -> dict[str, Any]:
    """Return the settings as options of Ray's tasks. Raises InputError for a wrong setting."""
    for key in settings:
        if key not in SETTINGS:
            raise unknown_name("setting of --launcher ray", key, SETTINGS)
    found: dict[str, Any] = {
        "num_cpus": _amount(settings, "cpus", processes),
        "num_gpus": _amount(settings, "gpus", 0),
        "max_retries": whole(settings, "retries", RETRIES, 0),
    }
    if "memory" in settings:
        found["memory"] = _bytes(settings["memory"])
    return found


def _require_listener(address: str) -> None:
    """Raise ConnectionError if nothing listens at HOST:PORT, which Ray would try for minutes."""
    found = re.fullmatch(r"(?:ray://)?\[?([^/\s]+?)\]?:(\d{1,5})", address, re.ASCII)
    if found:
        try:
            socket.create_connection((found[1], int(found[2])), timeout=10).close()
        except (OSError, OverflowError, UnicodeError):
            raise ConnectionError("nothing answers there") from None


def _first_line(error: Exception) -> str:
    return masked(next(iter(str(error).strip().splitlines()), ""))


def _amount(settings: Mapping[str, str], key: str, default: int) -> float:
    """Return a number of CPUs or GPUs, which may be a part of one."""
    text = settings.get(key, str(default))
    if not re.fullmatch(r"\d{1,4}(\.\d{1,4})?", text, re.ASCII):
        raise wrong_setting(key, text, "a number such as 1 or 0.5")
    return float(text)


def _bytes(text: str) -> int:
    found = re.fullmatch(r"(\d{1,12})([KMG]?)B?", text, re.ASCII)
    if not found:
        raise wrong_setting("memory", text, "a number of bytes such as 4G")
    return int(found[1]) * _UNITS[found[2]]
