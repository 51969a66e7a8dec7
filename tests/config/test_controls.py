"""The section `controls`: its entries, the specs of arms, and one sentence for each thing that is wrong with them."""

from pathlib import Path
from typing import Any

import pytest

from ssmail.config.controls import arm_specs, control, control_names
from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import load_experiments
from ssmail.config.names import flatten
from ssmail.errors import InputError

from .experiments_file import SHIPPED, write

PLAIN, SHARP = {"method": "gail"}, {"method": "gail", "settings": {"adversarial": {"input_noise": 0.5}}}
ENTRY = {
    "claim": "C1",
    "question": "Does it matter?",
    "environment": "yjunction",
    "metrics": ["test/mode_mse"],
    "arms": {"plain": PLAIN, "sharp": SHARP},
}


def file_with(folder: Path, change: dict[str, Any] | None = None, **sections: Any) -> Path:
    return write(folder / "e.yaml", controls={**SHIPPED.controls, "mine": {**ENTRY, **(change or {})}}, **sections)


@pytest.mark.parametrize("profile", SHIPPED.profiles)
@pytest.mark.parametrize("name", SHIPPED.controls)
def test_every_arm_of_every_shipped_control_is_a_spec_of_its_own(name: str, profile: str) -> None:
    found, specs = control(name), arm_specs(name, profile)
    assert list(specs) == [arm.name for arm in found.arms]
    assert len({spec.hash() for spec in specs.values()}) == len(specs) > 1
    assert found.question.endswith("?")


def test_the_shipped_controls_are_those_of_the_documentation() -> None:
    text = (Path(__file__).parents[2] / "docs" / "controls.md").read_text("utf-8")
    sections = {line.removeprefix("### ") for line in text.splitlines() if line.startswith("### ")}
    assert sections == set(control_names())
    for name in control_names():
        part = text.partition(f"### {name}\n")[2].partition("\n### ")[0]
        assert f"ssmail control {name}" in part
        assert all(f"`{arm.name}`" in part for arm in control(name).arms), name


@pytest.mark.parametrize("profile", SHIPPED.profiles)
def test_an_arm_costs_no_more_than_the_dearest_method_of_its_profile(profile: str) -> None:
    """Absolute settings, such as as many updates as another method has, fit each profile."""
    for name in SHIPPED.controls:
        for arm, spec in arm_specs(name, profile).items():
            most = build_spec("ssail", spec.environment, profile).training
            own = build_spec(spec.method, spec.environment, profile).training
            updates = spec.training.epochs * spec.training.updates
            allowed = max(part.epochs * part.updates for part in (most, own))
            assert updates <= 2 * allowed, (name, arm)  # smoke has two updates an epoch


def test_an_arm_is_the_method_with_its_settings(tmp_path: Path) -> None:
    specs = arm_specs("mine", "quick", file=file_with(tmp_path))
    assert specs["plain"].hash() == build_spec("gail", "yjunction", "quick").hash()  # so it shares the runs of `train`
    assert specs["sharp"] == build_spec("gail", "yjunction", "quick", ["adversarial.input_noise=0.5"])


def test_an_arm_may_be_on_an_environment_of_its_own(tmp_path: Path) -> None:
    file = file_with(tmp_path, {"arms": {"a": PLAIN, "b": {**PLAIN, "environment": "letters"}}})
    assert [spec.environment for spec in arm_specs("mine", "smoke", file=file).values()] == ["yjunction", "letters"]


def test_the_layers_of_an_arm(tmp_path: Path) -> None:
    sac = {"settings": {"sac": dict.fromkeys(("gamma", "polyak", "temperature"), 0.2)}}
    profile = {
        "sac": dict.fromkeys(("gamma", "polyak", "temperature", "graph_entropy"), 0.1),
        "controls": {"mine": {"sharp": {"sac": {"polyak": 0.3, "temperature": 0.3}}}},
    }
    arms = {"plain": PLAIN, "sharp": {"method": "gail", **sac}}
    file = file_with(tmp_path, {"arms": arms}, profiles={"quick": profile}, figures={})
    specs = arm_specs("mine", "quick", ["adversarial.input_noise=0.25"], file)
    sharp = specs["sharp"].sac
    assert (sharp.graph_entropy, sharp.gamma, sharp.polyak, sharp.temperature) == (0.1, 0.2, 0.3, 0.3)
    assert specs["plain"].sac.polyak == 0.1
    assert {spec.adversarial.input_noise for spec in specs.values()} == {0.25}
    assert build_spec("gail", "yjunction", "quick", file=file).sac.gamma == 0.1  # alone, it knows of no control


def test_a_file_without_controls_is_one_of_an_earlier_version(tmp_path: Path) -> None:
    profiles = {name: {**layer, "controls": {}} for name, layer in SHIPPED.profiles.items()}
    file = write(tmp_path / "e.yaml", controls=None, profiles=profiles)
    assert "controls" not in file.read_text().replace("controls: {}", "")
    assert control_names(file) == []
    assert build_spec("ssail", "yjunction", "quick", file=file) == build_spec("ssail", "yjunction", "quick")
    with pytest.raises(InputError, match=r"^unknown control 'mine'"):
        control("mine", file)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"claim": "C9"}, "controls.mine of e.yaml has the claim 'C9', which is none of C1 to C8; correct it."),
        ({"claim": ["C1", 2]}, "controls.mine of e.yaml has the claim '2', which is none of C1 to C8; correct it."),
        ({"claim": []}, "controls.mine of e.yaml needs claim (C1 to C8, or a list); add it."),
        ({"question": None}, "controls.mine of e.yaml needs question (text); add it."),
        ({"question": "why " * 100}, "the question in controls.mine of e.yaml has more than 300 characters; "),
        ({"metrics": "test/mse"}, "controls.mine of e.yaml needs metrics (a list); add it."),
        ({"metrics": [3]}, "controls.mine of e.yaml has the metric '3', which is no name such as test/mse; correct "),
        ({"environment": "yjuncton"}, "unknown environment in controls.mine.arms.plain of e.yaml 'yjuncton'; did you "),
        ({"armes": {}}, "unknown key 'armes' in controls.mine of e.yaml; did you mean arms?"),
        ({"arms": {"plain": PLAIN}}, "controls.mine of e.yaml needs two arms to compare; add one."),
        ({"arms": {"a": PLAIN, "b": None}}, "controls.mine.arms.b of e.yaml should be a mapping with a method and "),
        ({"arms": {"a": PLAIN, "b": {}}}, "controls.mine.arms.b of e.yaml needs method (text); add it."),
        ({"arms": {"a": PLAIN, "b": {"method": "gali"}}}, "unknown method in controls.mine.arms.b of e.yaml 'gali'; "),
        ({"arms": {"a": PLAIN, "b": {**SHARP, "set": 1}}}, "unknown key 'set' in controls.mine.arms.b of e.yaml; "),
        ({"arms": {"a": PLAIN, "b c": SHARP}}, "the name in controls.mine.arms.b c of e.yaml takes 1 to 40 letters, "),
        ({"arms": {"a": PLAIN, "b": PLAIN}}, "the arms a and b of controls.mine of e.yaml have the same settings in "),
        (
            {"arms": {"a": PLAIN, "b": {**PLAIN, "settings": {"sac": {"gama": 1}}}}},
            "unknown key 'sac.gama' in controls.mine.arms.b.settings of e.yaml; did you mean sac.gamma?",
        ),
        (
            {"arms": {"a": PLAIN, "b": {**PLAIN, "settings": {"sac": {"gamma": 2}}}}},
            "sac.gamma = 2 in controls.mine.arms.b.settings of e.yaml should be less than 1.",
        ),
    ],
)
def test_a_wrong_control_is_one_sentence(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        arm_specs("mine", "smoke", file=file_with(tmp_path, change))
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize("word", ["list", "all"])
def test_a_control_cannot_be_called_like_a_word_of_the_command(tmp_path: Path, word: str) -> None:
    with pytest.raises(InputError, match=rf"controls\.{word} of e\.yaml has a name that `ssmail control` needs"):
        control(word, write(tmp_path / "e.yaml", controls={word: ENTRY}))


@pytest.mark.parametrize(
    ("controls", "sentence"),
    [
        ({"mien": {}}, "unknown control in profiles.quick of e.yaml 'mien'; did you mean mine?"),
        ({"mine": {"shrap": {}}}, "unknown arm in profiles.quick.controls.mine of e.yaml 'shrap'; did you mean sharp?"),
        ({"mine": 3}, "profiles.quick.controls.mine of e.yaml should be a mapping, not '3'."),
    ],
)
def test_a_profile_that_speaks_to_what_there_is_not(tmp_path: Path, controls: Any, sentence: str) -> None:
    file = file_with(tmp_path, profiles={"quick": {"controls": controls}}, figures={})
    with pytest.raises(InputError) as caught:
        arm_specs("mine", "quick", file=file)
    assert str(caught.value) == sentence


@pytest.mark.parametrize("override", ["adversarial.input_noise=0.1", "adversarial={input_noise: 0.1}"])
def test_what_a_control_varies_cannot_be_set(tmp_path: Path, override: str) -> None:
    with pytest.raises(InputError, match=r"^adversarial\.input_noise is what the control mine varies; leave it out of"):
        arm_specs("mine", "smoke", [override], file_with(tmp_path))
    arms = {"a": {"method": "bc"}, "b": {"method": "bc", "settings": {"cloning": {"input_noise": 0.5}}}}
    other = file_with(tmp_path, {"arms": arms})
    with pytest.raises(InputError, match=r"^method bc on yjunction has no section 'adversarial' to set in --set"):
        arm_specs("mine", "smoke", [override], other)


def test_the_keys_of_an_arm_are_all_that_it_changes() -> None:
    """The shipped arms of one method differ in the keys of their settings alone, the profile's included."""
    experiments = load_experiments()
    for name in experiments.controls:
        arms = experiments.controls[name]["arms"]
        for arm, spec in arm_specs(name, "quick").items():
            plain = flatten(build_spec(spec.method, spec.environment, "quick").model_dump(mode="json"))
            own = flatten(spec.model_dump(mode="json"))
            changed = {key for key, value in own.items() if plain.get(key) != value}
            of_profile = experiments.profiles["quick"].get("controls", {}).get(name, {}).get(arm, {})
            given = {*flatten(arms[arm].get("settings", {})), *flatten(of_profile)}
            assert changed <= given, (name, arm)
