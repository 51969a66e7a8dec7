"""The process that computes one cell for `ssmail.execution.local`: a job comes in on stdin, events go out on stdout.

The end of stdin asks it to stop after the current epoch. It comes when the parent closes it, and also when the parent
dies in whatever way, so that no process is left training behind.
"""

import os
import signal
import threading

_STDIN, _STDOUT, _STDERR = 0, 1, 2


def main() -> None:
    """Compute the cell of the job on stdin."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    events = os.fdopen(os.dup(_STDOUT), "w", buffering=1)
    os.dup2(_STDERR, _STDOUT)  # what a library prints must not mix with the events
    line = _read_line()
    threading.Thread(target=_wait_for_end_of_stdin, args=(stop,), daemon=True).start()

    import torch  # imported late: seconds in which the signals above are heard already

    from ssmail.execution.cells import Event, Job
    from ssmail.execution.single import run_cell
    from ssmail.store import Store

    def send(event: Event) -> None:
        try:
            events.write(event.as_line() + "\n")
        except OSError:  # the parent is gone
            stop.set()

    torch.set_num_threads(1)
    job = Job.from_line(line)
    send(run_cell(job.cell, Store.open(job.store_url), job.settings, send, stop.is_set))


def _read_line() -> bytes:
    """The first line of stdin. Read without Python's buffers, whose lock a waiting thread would hold at exit."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(_STDIN, 65536)
        if not byte:
            raise EOFError("the job on stdin ended early")
        line += byte
    return line


def _wait_for_end_of_stdin(stop: threading.Event) -> None:
    while os.read(_STDIN, 65536):
        pass
    stop.set()


if __name__ == "__main__":
    main()
