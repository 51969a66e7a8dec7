"""The reference of the keys has every key, with a meaning, and what it says of types and ranges holds."""

import re
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import Field

from ssmail.config import keys
from ssmail.config.experiments import build_spec
from ssmail.config.spec import nearest_key, spec_keys
from ssmail.config.value_types import Frozen, Unit
from ssmail.errors import InputError

SECTIONS = keys.reference()
KEYS = {key.name: key for section in SECTIONS for key in section.keys}


def test_every_key_is_there_with_a_meaning_and_no_other() -> None:
    assert set(KEYS) == {name for name, is_section in spec_keys().items() if not is_section}
    for key in KEYS.values():
        assert re.fullmatch(r"\S.{8,}[.?)]", key.meaning), key.name
        assert key.kind
    for section in SECTIONS:
        assert section.meaning


def test_every_default_is_that_of_the_file(tmp_path: Path) -> None:
    assert (KEYS["sac.gamma"].default, KEYS["sac.average"].default, KEYS["model.discriminator_waves"].default) == (
        0.95, None, []
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "kind", "unit", "interval"),
    [
        ("sac.gamma", "number", "per step", "[0, 1)"),
        ("sac.average", "number or null", None, "(0, 1)"),
        ("sac.encoder_steps", "whole number or null", "steps", "[1, 1e+09]"),
        ("data.yjunction.steps", "whole number", "steps", "≥ 3"),
        ("adversarial.reward_scale", "number", None, "> 0"),
        ("model.standardize", "true, false, pooled or auto", None, None),
        ("self_supervision.label", "text or list", None, None),
        ("self_supervision.pairing", "start, nearest or assignment", None, None),
        ("forecast.noise", "number", "scaled units", "≥ 0"),
    ],
)
def test_types_units_and_ranges(name: str, kind: str, unit: str | None, interval: str | None) -> None:
    key = KEYS[name]
    assert (key.kind, key.unit, key.range) == (kind, unit, interval)


def test_a_section_says_who_uses_it() -> None:
    used = {section.name: section.used_by for section in SECTIONS}
    assert used["wasserstein"] == ("wail",)
    assert used["forecast"] == ("mocap", "trajectories")
    assert used["evaluation"] == ()


class Example(Frozen):
    """A section whose second key lacks a meaning."""

    below: Annotated[float, Field(lt=2), Unit("steps")] | None
    """Below
    two."""
    bare: int


def test_a_key_without_a_text_below_it_has_no_meaning(monkeypatch: pytest.MonkeyPatch) -> None:
    class Spec(Frozen):
        part: Example | None

    monkeypatch.setattr(keys, "RunSpec", Spec)
    (section,) = keys.reference()
    assert section.keys == (
        keys.Key("part.below", "number or null", "steps", "< 2", None, "Below two."),
        keys.Key("part.bare", "whole number", None, None, None, ""),
    )


def bounds(interval: str | None) -> list[tuple[float, bool]]:
    """The ends of an interval, and whether each belongs to it."""
    if interval is None or interval[0] not in "[(":
        return [] if interval is None else [(float(interval[1:]), interval[0] in "≥≤")]
    low, high = interval[1:-1].split(", ")
    return [(float(low), interval[0] == "["), (float(high), interval[-1] == "]")]


NUMBERS = [
    key for key in KEYS.values() if key.kind.startswith("number") and key.range and key.name[:4] in ("sac.", "curr")
]


@pytest.mark.parametrize("key", NUMBERS, ids=lambda key: key.name)
def test_the_ends_of_a_range_are_as_the_spec_takes_them(key: keys.Key) -> None:
    def takes(value: Any) -> bool:
        try:
            build_spec("ssail", "yjunction", "smoke", [f"{key.name}={value!r}"])
        except InputError:
            return False
        return True

    assert takes(0.5) or takes(1.5)
    for end, inside in bounds(key.range):
        assert takes(end) is inside


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("gamma", "did you mean sac.gamma?"),
        ("sac.gama", "did you mean sac.gamma?"),
        ("epoch", "did you mean training.epochs?"),
        ("bta", "did you mean beta?"),
        ("word", "did you mean data.letters.word?"),
        ("xyzzy", "choose from alpha, beta, or a key such as sac.gamma."),
    ],
)
def test_the_nearest_key_is_found_by_its_last_part_too(name: str, hint: str) -> None:
    assert nearest_key(name, ["alpha", "beta"]) == hint
