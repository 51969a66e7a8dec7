"""The specs of an ablation: one key varies, in whatever environment, and everything wrong is one sentence."""

import json
from pathlib import Path
from typing import Any

import pytest

from ssmail.config.experiments import ablation, ablation_specs, build_spec, display_value, to_tuples
from ssmail.config.names import flatten
from ssmail.errors import InputError

from .experiments_file import SHIPPED, write


def test_an_ablation_varies_one_key_alone() -> None:
    beta = ablation("beta")
    specs = ablation_specs("beta", "quick")
    assert list(specs) == list(beta.values)
    assert (beta.method, beta.environment, beta.key) == ("ssail", "yjunction", "curriculum.beta")
    flat = {value: flatten(json.loads(spec.as_json())) for value, spec in specs.items()}
    assert {value: spec.pop("curriculum.beta") for value, spec in flat.items()} == {value: value for value in flat}
    assert len({json.dumps(spec) for spec in flat.values()}) == 1


def test_the_values_of_an_ablation_may_be_given_and_count_once() -> None:
    assert list(ablation_specs("beta", "smoke", [0.5, 0, 0.0, 5e-1, 1])) == [0.5, 0.0, 1.0]
    assert all(isinstance(value, float) for value in ablation_specs("beta", "smoke", [0, 1]))


def test_ranges_are_values_too() -> None:
    alpha = ablation("alpha")
    assert (alpha.method, alpha.environment, alpha.key) == ("ssail", "mocap", "self_supervision.alpha")
    assert alpha.values == ((0.0, 1.0), (-1.0, 1.0))
    given = [[0, 1], [0.0, 1], [[-1, 0, 1], [0, 1, 3]]]
    specs = ablation_specs("alpha", "smoke", given)
    assert list(specs) == [(0.0, 1.0), ((-1.0, 0.0, 1.0), (0.0, 1.0, 3.0))]
    assert specs[0, 1].self_supervision.alpha_pieces == ((0.0, 1.0, 1.0),)


@pytest.mark.parametrize("environment", ["mocap", "yjunction"])
@pytest.mark.parametrize("profile", ["quick", "paper"])
def test_the_ablation_of_alpha_shares_the_runs_of_the_plain_method(profile: str, environment: str) -> None:
    """Where the profile gives the ablation no settings of its own."""
    specs = ablation_specs("alpha", profile, environment=environment)
    plain = build_spec("ssail", environment, profile)
    own = SHIPPED.profiles[profile] or {}
    shares = not {**own.get("ablations", {}).get("alpha", {}), **SHIPPED.ablations["alpha"].get("settings", {})}
    assert (specs[-1, 1].hash() == plain.hash()) is shares
    assert specs[0, 1].hash() != plain.hash()


def test_an_ablation_may_be_of_another_environment(tmp_path: Path) -> None:
    specs = ablation_specs("alpha", "smoke", environment="yjunction")
    assert {spec.environment for spec in specs.values()} == {"yjunction"}
    assert ablation("alpha", "yjunction").environment == "yjunction"
    with pytest.raises(InputError, match=r"^unknown environment 'moccap'; did you mean mocap\?$"):
        ablation_specs("alpha", "smoke", environment="moccap")
    entry = {"method": "ssail", "environment": "mocap", "key": "forecast.noise", "values": [0.0, 0.05]}
    file = write(tmp_path / "e.yaml", ablations={"noise": entry}, profiles={"smoke": {}}, figures={})
    assert len(ablation_specs("noise", "smoke", file=file)) == 2
    with pytest.raises(
        InputError, match=r"on yjunction has no section 'forecast' to set in ablations\.noise of e\.yaml"
    ):
        ablation_specs("noise", "smoke", file=file, environment="yjunction")


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (0.0, 0.0),
        ("word", "word"),
        (None, None),
        ((0.0, 1.0), [0, 1]),
        ((-0.5, 1.0), [-0.5, 1]),
        (((-1.0, 0.0, 1.0), (0.0, 1.5, 3.0)), [[-1, 0, 1], [0, 1.5, 3]]),
    ],
)
def test_values_are_written_as_people_do(value: Any, written: Any) -> None:
    assert str(display_value(value)) == str(written)
    assert to_tuples(written) == value


def test_two_ablations_share_the_spec_that_both_hold() -> None:
    curriculum, beta = (ablation_specs(name, "quick") for name in ("curriculum", "beta"))
    assert curriculum["trajectory-forcing"].hash() == beta[0.15].hash()
    assert curriculum["teacher-forcing"].hash() not in {spec.hash() for spec in beta.values()}


def test_the_layers_of_an_ablation(tmp_path: Path) -> None:
    entry = {**SHIPPED.ablations["beta"], "settings": {"sac": dict.fromkeys(("gamma", "polyak", "temperature"), 0.2)}}
    profile = {
        "sac": dict.fromkeys(("gamma", "polyak", "temperature", "graph_entropy"), 0.1),
        "ablations": {"beta": {"sac": {"polyak": 0.3, "temperature": 0.3}}},
    }
    file = write(tmp_path / "e.yaml", ablations={"beta": entry}, profiles={"quick": profile}, figures={})
    spec = ablation_specs("beta", "quick", [0.25], ["sac.temperature=0.4"], file)[0.25]
    assert (spec.sac.graph_entropy, spec.sac.gamma, spec.sac.polyak, spec.sac.temperature) == (0.1, 0.2, 0.3, 0.4)
    assert build_spec("ssail", "yjunction", "quick", file=file).sac.gamma == 0.1  # alone, it knows of no ablation


@pytest.mark.parametrize("profile", SHIPPED.profiles)
def test_an_ablation_costs_no_more_than_its_profile(profile: str) -> None:
    epochs = build_spec("ssail", "yjunction", profile).epochs
    assert all(spec.epochs <= epochs for name in SHIPPED.ablations for spec in ablation_specs(name, profile).values())


@pytest.mark.parametrize(
    ("name", "values", "overrides", "sentence"),
    [
        ("bta", None, [], "unknown ablation 'bta'; did you mean beta?"),
        ("beta", [0.1, 2], [], "curriculum.beta = 2 in --values should be less than or equal to 1."),
        ("beta", ["a"], [], "curriculum.beta = a in --values should be a number."),
        ("beta", None, ["sac.gama=1"], "unknown key 'sac.gama' in --set; did you mean sac.gamma?"),
        (
            "beta",
            None,
            ["curriculum={beta: 0.1}"],
            "curriculum.beta is what the ablation beta varies; give its values with --values, not --set.",
        ),
    ],
)
def test_a_bad_ablation_is_one_sentence(name: str, values: Any, overrides: list[str], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        ablation_specs(name, "smoke", values, overrides)
    assert str(caught.value) == sentence


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"values": []}, "ablations.beta of e.yaml needs values (a list); add it."),
        ({"key": None}, "ablations.beta of e.yaml needs key (text); add it."),
        ({"kye": "x"}, "unknown key 'kye' in ablations.beta of e.yaml; did you mean key?"),
        ({"key": "curriculum.bta"}, "unknown key 'curriculum.bta' in ablations.beta of e.yaml; "),
        ({"values": [3]}, "curriculum.beta = 3 in ablations.beta of e.yaml should be less than or equal to 1."),
        (
            {"method": "bc"},
            "method bc on yjunction has no section 'curriculum' to set in ablations.beta of e.yaml; it belongs to ",
        ),
        ({"method": "ssial"}, "unknown method 'ssial'; did you mean ssail?"),
        ({"settings": {"sac": {"gama": 1}}}, "unknown key 'sac.gama' in ablations.beta.settings of e.yaml; did you "),
    ],
)
def test_a_wrong_ablation_in_the_file_is_one_sentence(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    file = write(tmp_path / "e.yaml", ablations={"beta": {**SHIPPED.ablations["beta"], **change}}, figures={})
    with pytest.raises(InputError) as caught:
        ablation_specs("beta", "paper", file=file)
    assert str(caught.value).startswith(sentence)


def test_a_profile_that_speaks_to_an_unknown_ablation(tmp_path: Path) -> None:
    profiles = {"quick": {"ablations": {"bta": {}}}}
    with pytest.raises(InputError, match=r"unknown ablation in profiles\.quick of e\.yaml 'bta'; did you mean beta\?"):
        build_spec("ssail", "yjunction", "quick", (), write(tmp_path / "e.yaml", profiles=profiles))
