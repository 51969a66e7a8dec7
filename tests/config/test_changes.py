"""How a run's spec differs from its profile, as it is shown."""

import json
from pathlib import Path

import pytest

from ssmail.config.changes import changes, with_changes
from ssmail.config.experiments import ablation_specs, build_spec
from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.config.spec import RunSpec

from .experiments_file import SHIPPED, write


def stored(spec: RunSpec) -> dict[str, object]:
    found: dict[str, object] = json.loads(spec.as_json())
    return found


def test_a_plain_spec_has_no_changes() -> None:
    for method, environment in (("ssail", "yjunction"), ("dnri", "mocap"), ("copy-last", "letters")):
        assert changes(stored(build_spec(method, environment, "quick"))) == {}


def test_what_was_set_is_told() -> None:
    settings = ["training.epochs=12", "self_supervision.alpha=[0,1]", "sac.gamma=0.95"]  # the last one is no change
    found = changes(stored(build_spec("ssail", "yjunction", "quick", settings)))
    assert found == {"self_supervision.alpha": [0.0, 1.0], "training.epochs": 12}
    assert with_changes("quick", found) == "quick + self_supervision.alpha=[0, 1], training.epochs=12"
    assert with_changes("quick", {}) == "quick"
    assert with_changes("quick", dict.fromkeys("abcde", None)) == "quick + a=null, b=null, c=null and 2 more"


def test_an_ablation_changes_what_it_varies_and_sets() -> None:
    assert changes(stored(ablation_specs("beta", "quick", [0.5])[0.5])) == {
        "curriculum.beta": 0.5,
        "training.epochs": 40,
    }


def test_a_key_that_an_old_spec_lacks_is_no_change_and_what_is_unknown_has_none() -> None:
    spec = stored(build_spec("ssail", "yjunction", "smoke", ["sac.gamma=0.5"]))
    del spec["model"]["hidden"]  # type: ignore[attr-defined]
    assert changes(spec) == {"sac.gamma": 0.5}
    assert changes({**spec, "profile": "other"}) == {}
    assert changes({**spec, "method": "other"}) == {}


def test_the_file_in_use_says_what_a_profile_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = stored(build_spec("ssail", "yjunction", "smoke"))
    mine = write(tmp_path / "mine.yaml", methods={**SHIPPED.methods, "ssail": {"sac": {"gamma": 0.5}}})
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(mine))
    assert changes(spec) == {"sac.gamma": 0.95}
    mine.write_text("broken: [")
    assert changes(spec) == {}
