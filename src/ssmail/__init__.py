"""ssmail: the experiments of "SS-MAIL: Self-Supervised Multi-Agent Imitation Learning", run, stored and redrawn.

`load_run` returns the trained model of a stored run, a `TrainedRun`; docs/python.md is the tutorial. What is not in
`__all__` may change between versions.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmail.errors import InputError, SsmailError
    from ssmail.inference.trained_run import TrainedRun, load_run

__version__ = "0.1.0"
__all__ = ["InputError", "SsmailError", "TrainedRun", "__version__", "load_run"]

_PLACES = {
    "InputError": "ssmail.errors",
    "SsmailError": "ssmail.errors",
    "TrainedRun": "ssmail.inference.trained_run",
    "load_run": "ssmail.inference.trained_run",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import ssmail` loads neither torch nor pandas."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
