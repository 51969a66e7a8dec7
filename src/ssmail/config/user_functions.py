"""Python functions of the user, named in a spec as "module:function": how they are found, identified and loaded.

A module is a file in one of the user's own folders: beside the experiments.yaml in use, or in the current folder.
Installed packages are not searched. A spec that is built from experiments.yaml holds "module:function@digest", with the
first 12 digits of the SHA-256 of the module's file: a run belongs to the function as it was. The digest does not cover
what that file imports.

Only training executes such a file (`load_label`), and only with the digest of the spec that it trains. Everything else,
such as drawing a stored run, takes the name as text, or compares the digest.
"""

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

from ssmail.config import strict_yaml
from ssmail.config.experiments_file import PACKAGE, find_file
from ssmail.config.names import FUNCTION
from ssmail.errors import InputError, suggestion

if TYPE_CHECKING:
    from torch import Tensor

MOST_BYTES = 1_000_000  # of a file with a function
_LONGEST_REASON = 120  # characters of an exception in a message


@dataclass(frozen=True)
class UserFunction:
    """The parts of "package.module:function@digest". Without a digest, any content of the file is accepted."""

    module: str
    name: str
    digest: str | None = None

    @classmethod
    def parse(cls, text: Any) -> Self | None:
        """Return the parts of a text of this form, None for anything else."""
        found = FUNCTION.fullmatch(text) if isinstance(text, str) else None
        return cls(found["module"], found["name"], found["digest"]) if found else None

    def __str__(self) -> str:
        """Return the name without the digest, as the user writes it."""
        return f"{self.module}:{self.name}"

    def with_digest(self, folders: Sequence[Path]) -> str:
        """Return "module:function@digest" for the current content of the file.

        Raises InputError if there is no such file, or if this function has a digest and the file another one.
        """
        return f"{self}@{_digest(self._read(self._locate(folders)))}"

    def load(self, folders: Sequence[Path]) -> Callable[..., Any]:
        """Execute the file and return its function. Nothing is cached.

        While the file is executed, its own imports also find modules in `folders`, after everything else. Raises
        InputError as `with_digest` does, if the file cannot be executed, and if it does not define the function.
        """
        path = self._locate(folders)
        module = self._execute(path, self._read(path), folders)
        function = getattr(module, self.name, None)
        if not callable(function):
            names = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
            remedy = suggestion(self.name, names) if names else "define it there."
            raise InputError(f"{self}: {path} has no function {self.name}; {remedy}")
        return cast("Callable[..., Any]", function)

    def _locate(self, folders: Sequence[Path]) -> Path:
        """Return the file of the module. Looking for it imports nothing, not even the packages that contain it."""
        inside = Path(*self.module.split("."))
        for folder in folders:
            for path in (folder / inside.with_suffix(".py"), folder / inside / "__init__.py"):
                if _is_file(path):
                    if not path.resolve().is_relative_to(folder.resolve()):
                        raise InputError(f"{self}: {path} is a link out of its folder; copy the file there instead.")
                    return path
        where = " or ".join(dict.fromkeys(map(str, folders)))
        raise InputError(f"{self}: there is no {inside.with_suffix('.py')} in {where}; put it beside experiments.yaml.")

    def _read(self, path: Path) -> bytes:
        try:
            source = strict_yaml.read_bytes(path, MOST_BYTES)
        except InputError as error:
            raise InputError(f"{self}: {error}") from None
        if self.digest not in (None, _digest(source)):
            raise InputError(
                f"{self}: {path} has changed (digest {self.digest} then, {_digest(source)} now); "
                "restore it, or repeat the command without the @ and what follows it."
            )
        return source

    def _execute(self, path: Path, source: bytes, folders: Sequence[Path]) -> Any:
        """Return a new module made from `source`, which the digest covers; a compiled file of Python's may be older."""
        search = [str(path.parent)] if path.name == "__init__.py" else None
        spec = importlib.util.spec_from_file_location(self.module, path, submodule_search_locations=search)
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        before, paths = sys.modules.get(self.module), list(sys.path)
        sys.modules[self.module] = module  # where dataclasses and relative imports look
        sys.path += map(str, folders)
        try:
            exec(compile(source, str(path), "exec"), vars(module))
        except (Exception, SystemExit) as error:
            raise InputError(f"{self}: {path} cannot be imported, {_one_line(error)}; correct it.") from error
        finally:
            sys.path[:] = paths
            sys.modules.pop(self.module, None)
            if before is not None:
                sys.modules[self.module] = before
        return module


def search_folders(file: Path | None = None) -> tuple[Path, ...]:
    """Return the user's own folders: that of the experiments.yaml in use, unless it is ssmail's, and the current one.

    Raises InputError when the current folder has been removed.
    """
    try:
        beside, here = (file or find_file()).resolve().parent, Path.cwd()
    except (OSError, RuntimeError):  # RuntimeError: a loop of links
        raise InputError("the current folder has been removed; change to another one.") from None
    return tuple(dict.fromkeys(folder for folder in (beside, here) if folder != PACKAGE))


def load_label(label: Any) -> "Callable[[Tensor], Tensor] | None":
    """Load the user's label function that `self_supervision.label` names; None if the label is built in or knots.

    This executes the user's file, so it is for training alone, and for a spec that the user has asked for. The function
    gets a copy of the alphas (B,) on the CPU. Every call raises InputError, one sentence that names the function,
    unless it returns a tensor of finite labels (B,). Raises InputError for a label without a digest.
    """
    user_function = UserFunction.parse(label)
    if user_function is None:
        return None
    if user_function.digest is None:
        raise InputError(f"self_supervision.label: {user_function} names no digest; build the spec with build_spec.")
    import torch  # not at the top: a plan must not wait for torch

    function = user_function.load(search_folders())

    def unusable(problem: str, remedy: str) -> InputError:
        return InputError(f"self_supervision.label: the function {user_function} {problem}; {remedy}.")

    try:
        inspect.signature(function).bind(None)
    except TypeError as error:
        problem = f"cannot be called with one tensor of alphas ({_one_line(error)})"
        raise unusable(problem, "let it take that") from None
    except ValueError:  # it has no signature to inspect
        pass

    def label_function(alpha: "Tensor") -> "Tensor":
        with torch.no_grad():
            try:
                labels = function(alpha.detach().cpu().clone())
            except Exception as error:
                raise unusable(f"raises {_one_line(error)}, given {len(alpha)} alphas", "correct it") from error
        if not isinstance(labels, torch.Tensor):
            raise unusable(f"returns {type(labels).__name__}, not a tensor", "return a label for each of its alphas")
        if labels.shape != alpha.shape:
            problem = f"returns labels of shape {tuple(labels.shape)} for alphas of shape {tuple(alpha.shape)}"
            raise unusable(problem, "return a label for each of them")
        labels = labels.detach().to(alpha)
        wrong = alpha[~labels.isfinite()]
        if len(wrong):
            raise unusable(f"returns NaN or infinity for alpha {float(wrong[0]):.4g}", "return finite labels")
        return labels

    return label_function


def _digest(source: bytes) -> str:
    """Return the digest of a file. It does not depend on how the system ends lines."""
    return hashlib.sha256(source.replace(b"\r\n", b"\n")).hexdigest()[:12]


def _one_line(error: BaseException) -> str:
    """Return an exception as one line without a full stop."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:_LONGEST_REASON].rstrip(".: ")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # the name is too long, or a folder cannot be searched
        return False
