"""Where and with what a run is computed: commit, versions, host, and the resources that this process has used."""

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
    """The columns of `run` that say where it is computed, gathered once in each process."""
    commit, dirty = git_state(_ROOT)
    return {
        "git_commit": commit,
        "git_dirty": dirty,
        "package_version": ssmail.__version__,
        "torch_version": _torch_version(),
        "host": socket.gethostname(),
    }


def git_state(root: Path) -> tuple[str | None, bool | None]:
    """The commit of the ssmail checkout at `root`, and whether its code differs from it; None, None elsewhere."""
    if not (root / ".git").exists() or not (root / "src" / "ssmail").is_dir():
        return None, None
    commit = _git(root, "rev-parse", "HEAD")
    changes = _git(root, "status", "--porcelain", "--", "src", "cli", "experiments.yaml")
    if commit is None or changes is None:
        return None, None
    return commit, bool(changes)


def peak_memory_bytes() -> int:
    """The largest resident memory of this process so far, in bytes (host memory only, not that of a GPU)."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux: ru_maxrss would include the parent that started this process
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
        return version("torch")  # read from the package's metadata: importing torch takes seconds
    except PackageNotFoundError:
        return "none"
