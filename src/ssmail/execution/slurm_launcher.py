"""Jobs of SLURM, as an array, through submitit.

Only the submission and the requeueing are submitit's. Whether a job has ended is asked of `squeue`, which every SLURM
has; submitit asks `sacct`, which needs an accounting database.
"""

import io
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import submitit
from submitit.core.utils import DelayedSubmission, FailedJobError, FailedSubmissionError, pickle_load

from ssmail.errors import InputError, masked, shortened, unknown_name
from ssmail.execution.launchers import FAILED, INTERRUPTED, Ended, compute, was_interrupted, whole

MINUTES = 60
"""Time limit of a job by default. One that is not done by then is requeued, and resumes its runs."""
REQUEUES = 20
"""How often a job is requeued because its time was over, by default."""
_LARGEST_ARRAY = 1000  # SLURM's MaxArraySize is 1001 by default
_SHORT = {"cpus": "cpus_per_task", "gpus": "gpus_per_node", "timeout": "time"}
_NUMBERS = {"time": 1, "cpus_per_task": 1, "gpus_per_node": 0, "array_parallelism": 1, "signal_delay_s": 1}  # and least
_WORDS = (
    *("partition", "account", "qos", "mem", "mem_per_cpu", "mem_per_gpu", "gres", "constraint", "exclude", "nodelist"),
    *("job_name", "comment", "mail_type", "mail_user", "setup", "wckey"),
)
SETTINGS = (*_SHORT, *_NUMBERS, *_WORDS, "requeues")
_ENDED = {"COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "OUT_OF_MEMORY", "BOOT_FAIL", "DEADLINE"}
_ENDED |= {"PREEMPTED", "REVOKED"}
_INTERRUPTED = ("CANCELLED", "TIMEOUT", "PREEMPTED", "DEADLINE", "REVOKED")
_PATIENCE = 30.0  # seconds to wait for the result of a job that has left the queue: a shared folder may lag behind
_GRACE = 900.0  # seconds that a job which was asked to stop waits for SLURM to end it


class Resumable:
    """What a job runs: `compute`. submitit calls `checkpoint` when its time is over, and requeues the job."""

    def __call__(self, text: str) -> str:
        """Compute the cells of the job.

        After SIGTERM, its runs are interrupted at the end of their epoch. Whether the job was cancelled or will be
        requeued, only SLURM knows; a job that returned by itself would not be requeued. So it waits to be ended.
        """
        result = compute(text)
        if was_interrupted(result):
            time.sleep(_GRACE)
        return result

    def checkpoint(self, text: str) -> DelayedSubmission:
        """Return what the requeued job runs: the same, since the database knows how far the runs are."""
        return DelayedSubmission(self, text)


class SlurmLauncher:
    """Submits arrays of jobs with these settings; `folder` is for their logs, and has to be shared by all nodes."""

    def __init__(self, settings: Mapping[str, str], folder: Path, processes: int) -> None:
        given, requeues = parameters(settings, processes)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            folder.chmod(0o700)  # the jobs contain the URL of the database
        except OSError as error:
            raise InputError(f"{folder} cannot be used for the jobs of SLURM: {error.strerror}") from None
        try:
            self._executor = submitit.SlurmExecutor(folder=folder, max_num_timeout=requeues)
        except RuntimeError:
            raise InputError(
                "--launcher slurm finds no `srun` on this machine; start it on a login node of the cluster"
            ) from None
        self._executor.update_parameters(**given)
        self._jobs: dict[str, Any] = {}
        self._missing_since: dict[str, float] = {}

    def submit(self, jobs: Sequence[str]) -> list[str]:
        """Submit arrays of at most 1000 jobs."""
        names = []
        for first in range(0, len(jobs), _LARGEST_ARRAY):
            try:
                with redirect_stderr(io.StringIO()):  # of sbatch, which is in the error too
                    array = self._executor.map_array(Resumable(), jobs[first : first + _LARGEST_ARRAY])
            except (FailedJobError, FailedSubmissionError, OSError) as error:
                raise InputError(f"SLURM refused the jobs: {shortened(_last_line(str(error)), 200)}") from error
            self._jobs |= {job.job_id: job for job in array}
            names += [job.job_id for job in array]
        return names

    def poll(self) -> list[Ended]:
        """Ask squeue; of the jobs that have ended, read the results."""
        states = self._states()
        if states is None:  # the controller is busy, or restarts
            return []
        ended = []
        for name in list(self._jobs):
            state = states.get(name, "gone")
            if state in _ENDED or state == "gone":
                found = self._result(name, state)
                if found is not None:
                    ended.append(found)
                    self._jobs.pop(name).paths.submitted_pickle.unlink(missing_ok=True)
            else:
                self._missing_since.pop(name, None)
        return ended

    def cancel(self) -> None:
        """Cancel the arrays."""
        _run("scancel", *dict.fromkeys(name.partition("_")[0] for name in self._jobs))

    def close(self) -> None:
        """Do nothing: the jobs that are left belong to SLURM."""

    def _states(self) -> dict[str, str] | None:
        """Return the state of each of the user's jobs that SLURM still knows; None if it does not answer."""
        if not self._jobs:
            return {}
        said = _run("squeue", "--me", "--array", "--states=all", "--noheader", "--format=%i|%T")
        return None if said is None else dict(line.strip().split("|", 1) for line in said.splitlines() if "|" in line)

    def _result(self, name: str, state: str) -> Ended | None:
        """Return how a job has ended; None if its result may still show up."""
        paths = self._jobs[name].paths
        if paths.result_pickle.exists():
            outcome, result = pickle_load(paths.result_pickle)  # written by our own job, in our own folder
            paths.result_pickle.unlink()
            if outcome == "success":
                return Ended(name, str(result))
            kind = INTERRUPTED if "UncompletedJobError" in str(result) else FAILED
            return Ended(name, None, kind, f"its SLURM job {name} ended: {_last_line(str(result))}")
        if state in ("gone", "COMPLETED"):
            since = self._missing_since.setdefault(name, time.monotonic())
            if time.monotonic() - since < _PATIENCE:
                return None
        kind = INTERRUPTED if state in _INTERRUPTED else FAILED
        how = "is gone" if state == "gone" else f"ended as {state}"
        log = paths.stderr.read_text(errors="replace") if paths.stderr.exists() else ""
        reason = "" if state == "CANCELLED" else _last_line(log)
        return Ended(name, None, kind, f"its SLURM job {name} {how}{f': {reason}' if reason else ''}")


def parameters(settings: Mapping[str, str], processes: int = 1) -> tuple[dict[str, Any], int]:
    """Return the settings as submitit's parameters, and how often to requeue. Raises InputError for a wrong setting."""
    given: dict[str, Any] = {}
    for key, text in settings.items():
        name = _SHORT.get(key.removeprefix("slurm_"), key.removeprefix("slurm_"))
        if name not in SETTINGS:
            raise unknown_name("setting of --launcher slurm", key, SETTINGS)
        given[name] = text
    numbers = {key: whole(given, key, 0, least) for key, least in _NUMBERS.items() if key in given}
    requeues = whole(given, "requeues", REQUEUES, 0)
    words = {key: [given[key]] if key == "setup" else given[key] for key in _WORDS if key in given}
    defaults = {"job_name": "ssmail", "time": MINUTES, "cpus_per_task": processes, "wckey": None}
    return {**defaults, **words, **numbers}, requeues


def _run(*command: str) -> str | None:
    """Return what a command of SLURM prints; None if it fails."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    except (OSError, subprocess.SubprocessError):
        return None


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return masked(lines[-1]) if lines else ""
