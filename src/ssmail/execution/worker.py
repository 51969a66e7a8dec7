"""The worker process of `ssmail.execution.local`: reads a job from stdin, computes its cells, writes events to stdout.

It stops after the current epoch when stdin ends. That happens when the parent closes it, but also when the parent dies
for any reason, so that no worker goes on training.
"""

import os
import signal
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssmail.execution.run_together import MakeLoop

_STDIN, _STDOUT, _STDERR = 0, 1, 2


def main(make_loop: "MakeLoop | None" = None) -> None:
    """Compute the cells of the job on stdin with `make_loop`, by default TrainingLoop."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    events = os.fdopen(os.dup(_STDOUT), "w", buffering=1)
    os.dup2(_STDERR, _STDOUT)  # keeps output of libraries out of the events
    line = _read_line()
    threading.Thread(target=_wait_for_end_of_stdin, args=(stop,), daemon=True).start()

    import torch  # imported late: it takes seconds, in which the signals above must be handled already

    from ssmail.execution.cells import Event, Job
    from ssmail.execution.run_together import run_together
    from ssmail.store import Store
    from ssmail.store.connection import BUSY_SECONDS
    from ssmail.training.loop import TrainingLoop

    def send(event: Event) -> None:
        try:
            events.write(event.as_line() + "\n")
        except OSError:  # the parent is gone
            stop.set()

    torch.set_num_threads(1)
    job = Job.from_line(line)
    store = Store.open(job.store_url, patience=BUSY_SECONDS, artifacts=job.settings.artifacts)
    claims = dict(zip(job.cells, job.claims, strict=True))
    run_together(job.cells, store, job.settings, send, stop.is_set, make_loop or TrainingLoop, claims)


def _read_line() -> bytes:
    """Read the first line of stdin, without Python's buffers, whose lock a waiting thread would hold at exit."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(_STDIN, 65536)
        if not byte:
            raise EOFError("stdin ended before the job was complete")
        line += byte
    return line


def _wait_for_end_of_stdin(stop: threading.Event) -> None:
    while os.read(_STDIN, 65536):
        pass
    stop.set()


if __name__ == "__main__":
    main()
