"""The names of methods, environments and functions, and keys with dots, for those who need no spec: importing this is
quick.
"""

import re
from collections.abc import Mapping
from typing import Any, Literal, get_args

Method = Literal["ssail", "gail", "wail", "bc", "nri", "dnri", "constant-velocity", "copy-last"]
METHODS: tuple[str, ...] = get_args(Method)
Environment = Literal["yjunction", "letters", "mocap", "trajectories"]
ENVIRONMENTS: tuple[str, ...] = get_args(Environment)
# "module:function", or "module:function@digest" once the file has been read; see ssmail.config.user_functions
FUNCTION = re.compile(r"(?P<module>[^\W\d]\w*(\.[^\W\d]\w*)*):(?P<name>[^\W\d]\w*)(@(?P<digest>[0-9a-f]{12}))?")


DEFAULT_METHOD: Method = "ssail"  # of a command that names none
DEFAULT_ENVIRONMENT: Environment = "yjunction"  # likewise


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted key: {"a": {"b": 1}} -> {"a.b": 1}. An empty mapping counts as a value."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        nested = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat
