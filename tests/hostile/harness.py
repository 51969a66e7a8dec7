"""Runs one hostile input in this process and says what was wrong with how ssmail took it.

Allowed ends are success and a refusal: a single sentence of at most 300 printable characters. An audit hook watches
what Python does meanwhile: nothing outside the input's own folder may be written, removed or linked, no process or
connection started, and no module imported that only an attacker would name.

Each module decorates its properties with `cases(quick, fuzz)`: the number of examples in `make test` and in
`make fuzz`, whose shares add up to 20,000.
"""

import contextlib
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from hypothesis import HealthCheck, settings

from ssmail_cli.main import run

FUZZING = "SSMAIL_FUZZ" in os.environ
LONGEST = 300  # characters of a sentence, less "ssmail: "
SECONDS = 20  # for one case
TRAPS = ("this", "antigravity", "turtle", "idlelib", "lib2to3", "ssmail_trap")
"""Modules that nothing of ssmail imports; a hostile file names them to be found out."""

STARTS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "pty.spawn")
CHANGES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod")
CHANGES += ("shutil.rmtree", "shutil.move", "shutil.copyfile", "sqlite3.connect")

Test = TypeVar("Test", bound=Callable[..., Any])
counted = 0
"""The cases that this process has run."""
killed = 0
"""The living processes that the crash test has killed."""


def cases(quick: int, fuzz: int) -> Callable[[Test], Test]:
    """Settings for a property: its number of examples. The quick ones are the same in every run."""
    slow = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
    return settings(
        max_examples=fuzz if FUZZING else quick,
        derandomize=not FUZZING,
        deadline=None,
        database=None,
        suppress_health_check=slow,
    )


@dataclass
class Watch:
    """What the audit hook has seen in a folder's case."""

    folder: Path
    wrong: list[str] = field(default_factory=list)

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in STARTS:
            self.wrong.append(f"{event} {arguments[:2]!r}")
        elif event == "open" and self._writes(arguments):
            self._outside(event, arguments[:1])
        elif event in CHANGES:
            self._outside(event, arguments[: 2 if event in ("os.rename", "os.link") else 1])

    def _outside(self, event: str, paths: Sequence[Any]) -> None:
        for path in paths:
            if not isinstance(path, str | bytes | os.PathLike):
                continue
            place = os.fsdecode(path).removeprefix("file:").split("?")[0]
            if place in ("", ":memory:", os.devnull) or "__pycache__" in place:
                continue
            if not Path(os.path.realpath(place)).is_relative_to(self.folder.resolve()):
                self.wrong.append(f"{event} {place}")

    @staticmethod
    def _writes(arguments: tuple[Any, ...]) -> bool:
        _, mode, flags = arguments
        if isinstance(mode, str):
            return any(letter in mode for letter in "wax+")
        return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


_watches: list[Watch] = []
_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    for watch in tuple(_watches):
        watch.see(event, arguments)


@contextlib.contextmanager
def watching(folder: Path) -> Iterator[Watch]:
    """Watch what happens; the block may write below `folder` only. Look at `.wrong` afterwards."""
    global _hooked
    if not _hooked:
        sys.addaudithook(_hook)  # for the life of the process
        _hooked = True
    for name in [name for name in sys.modules if name.split(".")[0] in TRAPS]:
        del sys.modules[name]
    watch = Watch(folder)
    _watches.append(watch)
    try:
        yield watch
    finally:
        _watches.remove(watch)
        watch.wrong += [f"imported {name}" for name in sys.modules if name.split(".")[0] in TRAPS]


@contextlib.contextmanager
def time_limit(seconds: int = SECONDS) -> Iterator[None]:
    """Raise TimeoutError in the block after so many seconds."""

    def late(_signal: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"took longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def hold(folder: Path, *arguments: object) -> tuple[int, str, str]:
    """Run a command line whose files lie below `folder`; return exit code, stdout, stderr once all is well with them.

    Raises AssertionError otherwise.
    """
    global counted
    counted += 1
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        time_limit(),
        watching(folder) as watch,
    ):
        code = run([str(argument) for argument in arguments])
    assert not watch.wrong, watch.wrong
    held(code, out.getvalue(), err.getvalue())
    return code, out.getvalue(), err.getvalue()


def held(code: int, out: str, err: str) -> None:
    """Assert that a command ended as one may: with a code of its own, and printable text of bearable length.

    With exit code 1 and a result on stdout, the result is the reason (`ssmail db check`, `ssmail explain`).
    """
    assert code in (0, 1, 2, 3), code
    assert "Traceback" not in err, err
    assert not re.search(r"unexpected \w*(Error|Exception|Warning|Exit|Iteration)\b", err), err
    for text in (out, err):
        bad = [character for character in text if not character.isprintable() and character not in "\n"]
        assert not bad, (bad, text)
    *_, last = err.splitlines() or [""]
    assert code != 2 or last.startswith("ssmail: "), err
    if last.startswith("ssmail: "):
        assert len(last) <= len("ssmail: ") + LONGEST, last


def refused(folder: Path, *arguments: object) -> str:
    """Run a command line that has to be refused with exit code 2 and return its sentence."""
    code, _, err = hold(folder, *arguments)
    assert code == 2, (code, err)
    return err.splitlines()[-1].removeprefix("ssmail: ")


def mutated(data: bytes, seed: int, changes: int = 3) -> bytes:
    """Return `data` with some bytes changed, cut out, repeated or inserted, as `seed` says."""
    import random

    draw = random.Random(seed)
    out = bytearray(data)
    for _ in range(draw.randint(1, changes)):
        place = draw.randrange(len(out) + 1)
        size = min(draw.choice((1, 1, 1, 2, 4, 16, 200)), len(out) - place)
        kind = draw.randrange(5)
        if kind == 0 and size:
            out[place] = draw.randrange(256)
        elif kind == 1:
            del out[place : place + size]
        elif kind == 2:
            out[place:place] = out[place : place + size]
        elif kind == 3:
            out[place:place] = draw.randbytes(draw.choice((1, 2, 8)))
        elif size:
            out[place : place + size] = draw.choice((b"\x00", b"\xff", b"9", b"-", b"{", b"\x1b", b"\n")) * size
    return bytes(out)
