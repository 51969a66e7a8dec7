"""How the spec of a stored run differs from its profile, as --set and ablations change it.

Runs store whole specs, not the commands that made them. So a run is compared with what the experiments.yaml in use
gives for its method, environment and profile.
"""

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from ssmail.config.experiments import build_spec, display_value, to_tuples
from ssmail.config.experiments_file import Experiments, load_experiments
from ssmail.config.names import flatten
from ssmail.config.strict_yaml import inline
from ssmail.errors import InputError

MOST_SHOWN = 3  # changes that are written out


def changes(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return the dotted keys in which a stored spec (nested values) differs from its profile, with its values.

    A key that the spec is too old to have is no change. An unknown method, environment or profile has no changes.
    """
    try:
        plain = _plain(load_experiments(), spec["method"], spec["environment"], spec["profile"])
    except InputError:
        return {}
    given = flatten(spec)
    return {key: value for key, value in given.items() if to_tuples(plain.get(key)) != to_tuples(value)}


def with_changes(profile: str, changed: Mapping[str, Any]) -> str:
    """Return a profile with the changes to it: "quick + training.epochs=12"."""
    told = [f"{key}={inline(display_value(value))}" for key, value in changed.items()]
    rest = len(told) - MOST_SHOWN
    return " + ".join([profile, *([", ".join(told[:MOST_SHOWN])] if told else [])]) + f" and {rest} more" * (rest > 0)


@functools.lru_cache(maxsize=64)
def _plain(experiments: Experiments, method: str, environment: str, profile: str) -> Mapping[str, Any]:
    """Return the values of the spec without changes, by dotted key. The specs of a file are built once."""
    spec = build_spec(method, environment, profile, file=experiments.path)
    return MappingProxyType(flatten(spec.model_dump(mode="json")))
