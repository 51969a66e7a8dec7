"""A worker process with another training loop: python -m tests.execution.fake_worker MODULE CLASS.

`fake_worker(Walk)` is the command to pass to `run_cells`.
"""

import importlib
import sys

from ssmail.execution.worker import main


def fake_worker(loop: type) -> tuple[str, ...]:
    return sys.executable, "-P", "-m", "tests.execution.fake_worker", loop.__module__, loop.__name__


if __name__ == "__main__":
    main(getattr(importlib.import_module(sys.argv[1]), sys.argv[2]))
