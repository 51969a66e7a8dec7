"""Metadata of the run's environment: commit, versions, host, and the peak memory of this process."""

import functools
import resource
import socket
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import ssmail

_ROOT = Path(ssmail.__file__).resolve().parents[2]


@functools.cache
def columns() -> dict[str, Any]:
    """Return the columns of `run` that describe code and machine; they are collected once per process."""
    commit, dirty = git_state(_ROOT)
    return {
        "git_commit": commit,
        "git_dirty": dirty,
        "package_version": ssmail.__version__,
        "torch_version": _torch_version(),
        "host": socket.gethostname(),
    }


def git_state(root: Path) -> tuple[str | None, bool | None]:
    """Return the commit of the ssmail checkout at `root` and whether its code has uncommitted changes.

    Returns (None, None) when `root` is not a checkout of ssmail or git fails.
    """
    if not (root / ".git").exists() or not (root / "src" / "ssmail").is_dir():
        return None, None
    commit = _git(root, "rev-parse", "HEAD")
    changes = _git(root, "status", "--porcelain", "--", "src", "cli", "experiments.yaml")
    if commit is None or changes is None:
        return None, None
    return commit, bool(changes)


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this process so far, in bytes (host memory, not GPU memory)."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux, ru_maxrss would include the parent that forked this process
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _git(root: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(root), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _torch_version() -> str:
    try:
        return version("torch")  # from the package metadata, because importing torch takes seconds
    except PackageNotFoundError:
        return "none"
