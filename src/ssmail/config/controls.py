"""The section `controls` of experiments.yaml: experiments that switch off what a verdict is credited to.

A control asks one question about one or several claims. Its arms are specs, each of a method of its own, and all are
compared with the first one. No report and no verdict needs a control; they are trained and drawn on demand.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ssmail.config.experiments import merge_layers, override_layers
from ssmail.config.experiments_file import CONTROL_LAYERS, LAYERS, Experiments, load_experiments
from ssmail.config.names import flatten
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, printable, shortened, suggestion, unknown_name

LISTED, EVERY = "list", "all"
"""Words of the command line, which no control may be called."""
LONGEST = 300  # characters of a question
_NAME = re.compile(r"[\w+.=-]{1,40}", re.ASCII)
_CLAIM = re.compile(r"C[1-8]")
_KEYS = {
    "claim": "C1 to C8, or a list",
    "question": "text",
    "environment": "text",
    "metrics": "a list",
    "arms": "a mapping",
}
_ARM_KEYS = ("method", "environment", "settings")


@dataclass(frozen=True)
class Arm:
    """One of the specs that a control compares; its settings stay in the file."""

    name: str
    method: str
    environment: str


@dataclass(frozen=True)
class Control:
    """A question and the arms that answer it; the first arm is what the others are compared with."""

    name: str
    claims: tuple[str, ...]  # "C4"
    question: str
    environment: str  # of the arms that name none
    metrics: tuple[str, ...]  # that its figure draws
    arms: tuple[Arm, ...]


def control_names(file: Path | None = None) -> list[str]:
    """Return the names of the controls, in the order of the file."""
    return list(load_experiments(file).controls)


def control(name: str, file: Path | None = None) -> Control:
    """Return the control `name` of experiments.yaml. Raises InputError for an unknown control or a wrong entry."""
    experiments = load_experiments(file)
    entry = experiments.entry("control", name)
    source = f"controls.{name} of {experiments.path.name}"
    _check_name(name, f"the name in {source}")
    if name in (LISTED, EVERY):
        raise InputError(f"{source} has a name that `ssmail control` needs for itself; choose another.")
    _check_known(entry, _KEYS, source)
    claims = entry.get("claim")
    claims = [claims] if isinstance(claims, str) else claims
    kinds = {"question": str, "environment": str, "metrics": list, "arms": Mapping}
    for key, what in _KEYS.items():
        value = claims if key == "claim" else entry.get(key)
        if not value or not isinstance(value, kinds.get(key, list)):
            raise InputError(f"{source} needs {key} ({what}); add it.")
    assert isinstance(claims, list)
    for claim in claims:
        if not isinstance(claim, str) or not _CLAIM.fullmatch(claim):
            raise InputError(f"{source} has the claim {_shown(claim)}, which is none of C1 to C8; correct it.")
    for metric in entry["metrics"]:
        if not isinstance(metric, str):
            raise InputError(
                f"{source} has the metric {_shown(metric)}, which is no name such as test/mse; correct it."
            )
    if len(entry["question"]) > LONGEST:
        raise InputError(f"the question in {source} has more than {LONGEST} characters; ask it in one sentence.")
    if len(entry["arms"]) < 2:
        raise InputError(f"{source} needs two arms to compare; add one.")
    arms = tuple(_read_arm(experiments, name, arm, entry["environment"]) for arm in entry["arms"])
    question = " ".join(entry["question"].split())
    return Control(name, tuple(claims), question, entry["environment"], tuple(entry["metrics"]), arms)


def arm_specs(name: str, profile: str, overrides: Sequence[str] = (), file: Path | None = None) -> dict[str, RunSpec]:
    """Return the spec of each arm of a control, in its order.

    The overrides ("key.path=value") hold for every arm. Raises InputError as `ssmail.config.experiments.build_spec`
    does, for an override of a key in which the arms differ, for a profile that speaks to an arm that there is not, and
    for two arms with the same spec.
    """
    experiments = load_experiments(file)
    found = control(name, file)
    source = f"controls.{name} of {experiments.path.name}"
    layers = {
        arm: experiments.layers(LAYERS, environment=arm.environment, method=arm.method, profile=profile)
        for arm in found.arms
    }
    _check_profile(experiments, found, profile)
    own = {arm: experiments.layers(CONTROL_LAYERS, control=name, arm=arm.name, profile=profile) for arm in found.arms}
    varied = {key for given in own.values() for layer in given for key in flatten(layer.values)}
    specs: dict[str, RunSpec] = {}
    for arm in found.arms:
        given = override_layers(overrides, arm.method, arm.environment, "--set")
        for key in (key for layer in given for key in flatten(layer.values)):
            if key in varied:
                raise InputError(f"{key} is what the control {name} varies; leave it out of --set.")
        spec, _ = merge_layers(experiments, [*layers[arm], *own[arm], *given], arm.method, arm.environment, profile)
        for other, known in specs.items():
            if known == spec:
                raise InputError(
                    f"the arms {other} and {arm.name} of {source} have the same settings in profile "
                    f"{profile}; change one of them, or choose another profile."
                )
        specs[arm.name] = spec
    return specs


def _read_arm(experiments: Experiments, control_name: str, name: Any, environment: str) -> Arm:
    source = f"controls.{control_name}.arms.{name} of {experiments.path.name}"
    _check_name(name, f"the name in {source}")
    entry = experiments.controls[control_name]["arms"][name]
    if not isinstance(entry, Mapping):
        raise InputError(f"{source} should be a mapping with a method and settings, not {_shown(entry)}.")
    _check_known(entry, _ARM_KEYS, source)
    chosen = {"method": entry.get("method"), "environment": entry.get("environment", environment)}
    for kind, value in chosen.items():
        if not isinstance(value, str) or not value:
            raise InputError(f"{source} needs {kind} (text); add it.")
        known = getattr(experiments, f"{kind}s")
        if value not in known:
            raise unknown_name(f"{kind} in {source}", value, known)
    return Arm(name, **chosen)


def _check_profile(experiments: Experiments, found: Control, profile: str) -> None:
    """Raise InputError if the profile has settings for an arm that the control does not have."""
    spoken = (experiments.profiles[profile] or {}).get("controls") or {}
    given, names = spoken.get(found.name) or {}, [arm.name for arm in found.arms]
    source = f"profiles.{profile}.controls.{found.name} of {experiments.path.name}"
    if not isinstance(given, Mapping):
        raise InputError(f"{source} should be a mapping, not {_shown(given)}.")
    for name in given:
        if name not in names:
            raise unknown_name(f"arm in {source}", str(name), names)


def _check_known(entry: Mapping[str, Any], known: Sequence[str] | Mapping[str, Any], source: str) -> None:
    for key in entry:
        if key not in known:
            raise InputError(f"unknown key '{shortened(str(key), 60)}' in {source}; {suggestion(str(key), known)}")


def _check_name(name: Any, what: str) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"{shortened(what, 120)} takes 1 to 40 letters, digits and signs such as - and +; change it.")


def _shown(value: Any) -> str:
    return f"'{shortened(printable(value), 60)}'"
