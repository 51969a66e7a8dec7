"""A user's own Python function, named in a spec as "module:function": where its file is, what it is known by, and how
it is loaded.

The file is looked for in the given folders, then among the installed packages. A spec that is built from
experiments.yaml holds the first digits of the SHA-256 of that file behind the name, "module:function@digest": a run is
of the function as it was. What the file itself imports is not in the digest.
"""

import hashlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from ssmail.config.keys import nearest
from ssmail.config.shaping import FUNCTION
from ssmail.errors import InputError


@dataclass(frozen=True)
class UserFunction:
    """The parts of "package.module:function@digest"; digest None: whatever the file holds now."""

    module: str
    name: str
    digest: str | None = None

    @classmethod
    def parse(cls, text: Any) -> Self | None:
        """The parts of a text of this form; None for anything else."""
        found = FUNCTION.fullmatch(text) if isinstance(text, str) else None
        return cls(found["module"], found["name"], found["digest"]) if found else None

    def __str__(self) -> str:
        """As the user writes it."""
        return f"{self.module}:{self.name}"


def pinned(function: UserFunction, folders: Sequence[Path]) -> str:
    """ "module:function@digest" of its file as it is now.

    Raises InputError when there is no such file, and when the function has a digest and the file another one.
    """
    path = _locate(function, folders)
    return f"{function}@{_digest(_read(function, path))}"


def load(function: UserFunction, folders: Sequence[Path]) -> Callable[..., Any]:
    """Execute the file, afresh each time, and return what it calls `name`.

    While it is executed its own imports find the folders too, after everything else. Raises InputError as `pinned`
    does, when the file cannot be executed, and when it has no function of that name.
    """
    path = _locate(function, folders)
    source = _read(function, path)
    module = _execute(function, path, source, folders)
    found = getattr(module, function.name, None)
    if not callable(found):
        names = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        remedy = nearest(function.name, names) if names else "define it there."
        raise InputError(f"{function}: {path} has no function {function.name}; {remedy}")
    made: Callable[..., Any] = found
    return made


def _locate(function: UserFunction, folders: Sequence[Path]) -> Path:
    inside = Path(*function.module.split("."))
    for folder in folders:
        for path in (folder / inside.with_suffix(".py"), folder / inside / "__init__.py"):
            if path.is_file():
                return path
    try:
        spec = importlib.util.find_spec(function.module)
    except Exception:  # of a parent package that cannot be imported, or is none
        spec = None
    if spec is None:
        where = " or ".join(dict.fromkeys(map(str, folders)))
        raise InputError(
            f"{function}: there is no module {function.module} in {where}, nor is it installed; "
            f"put {inside.with_suffix('.py')} beside experiments.yaml."
        )
    if not spec.has_location or not str(spec.origin).endswith(".py"):
        raise InputError(f"{function}: {function.module} is no Python file; name a function of one.")
    return Path(str(spec.origin))


def _read(function: UserFunction, path: Path) -> bytes:
    """The file's content, whose digest is that of the function if it has one."""
    try:
        source = path.read_bytes()
    except OSError as error:
        raise InputError(f"{function}: {path} cannot be read: {error.strerror}.") from None
    if function.digest not in (None, _digest(source)):
        raise InputError(
            f"{function}: {path} is not the file it was ({function.digest} then, {_digest(source)} now); "
            "restore it, or give the command again without what stands behind the @."
        )
    return source


def _digest(source: bytes) -> str:
    """The same on a system that ends lines in another way."""
    return hashlib.sha256(source.replace(b"\r\n", b"\n")).hexdigest()[:12]


def _execute(function: UserFunction, path: Path, source: bytes, folders: Sequence[Path]) -> Any:
    """A new module of this source, which is what the digest is of; a compiled file of Python's could be another."""
    search = [str(path.parent)] if path.name == "__init__.py" else None
    spec = importlib.util.spec_from_file_location(function.module, path, submodule_search_locations=search)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    before, paths = sys.modules.get(function.module), list(sys.path)
    sys.modules[function.module] = module  # dataclasses and relative imports look there
    sys.path += map(str, folders)
    try:
        exec(compile(source, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        raise InputError(f"{function}: {path} cannot be imported, {told(error)}; correct it.") from error
    finally:
        sys.path[:] = paths
        sys.modules.pop(function.module, None)
        if before is not None:
            sys.modules[function.module] = before
    return module


def told(error: BaseException) -> str:
    """An exception on one line, without a full stop."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(".: ")
