"""The errors that ssmail raises on purpose. Each message is one sentence that names the culprit and the remedy."""


class SsmailError(Exception):
    """Something failed that is not the user's input (exit code 1)."""

    exit_code = 1


class InputError(SsmailError):
    """A value, file, key or path that the user gave cannot be used (exit code 2)."""

    exit_code = 2
