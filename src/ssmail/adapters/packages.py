"""The packages of the extra `adapters`, which ssmail itself does without."""

from ssmail.errors import InputError


def missing(error: ModuleNotFoundError) -> InputError:
    """Return the InputError for a package that is not installed."""
    return InputError(f"{error.name} is not installed; run `pip install 'ssmail[adapters]'`")
