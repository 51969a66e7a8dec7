"""What a spec holds in each environment, and what it is known by."""

import contextlib
import hashlib
import json

import pytest
from hypothesis import given as given_by
from hypothesis import strategies as st
from pydantic import ValidationError

from ssmail.config import spec as specs
from ssmail.config.experiments import build_spec
from ssmail.config.names import ENVIRONMENTS, METHODS
from ssmail.config.shaping import read_label
from ssmail.config.spec import (
    ENVIRONMENT_SECTIONS,
    METHOD_SECTIONS,
    OPTIONAL_SECTIONS,
    RunSpec,
    required_sections,
    spec_hash,
)
from ssmail.errors import InputError

NO_DATA = {"path": None, "yjunction": None, "letters": None}


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("method", METHODS)
def test_a_spec_has_the_sections_of_its_method_and_environment(method: str, environment: str) -> None:
    made = build_spec(method, environment, "smoke")
    there = {name for name in OPTIONAL_SECTIONS if getattr(made, name) is not None}
    assert there == set(required_sections(method, environment))
    assert there == {*METHOD_SECTIONS[method], *ENVIRONMENT_SECTIONS[environment]}
    assert (made.forecast is not None) is (environment in ("mocap", "trajectories"))
    assert (made.data.yjunction is not None) is (environment == "yjunction")
    assert (made.data.letters is not None) is (environment == "letters")
    assert (made.data.path is not None) is (environment in ("mocap", "trajectories"))


@pytest.mark.parametrize(
    ("environment", "changes", "sentence"),
    [
        ("yjunction", {"forecast": "of mocap"}, "bc on yjunction has no section forecast"),
        ("mocap", {"forecast": None}, "bc on mocap needs section forecast"),
        ("mocap", {"cloning": None}, "bc on mocap needs section cloning"),
        ("yjunction", {"data": NO_DATA}, "environment yjunction needs data.yjunction"),
        ("letters", {"data": NO_DATA}, "environment letters needs data.letters"),
        ("mocap", {"data": NO_DATA}, "environment mocap needs a data file; set data.path"),
        ("yjunction", {"data": "of letters"}, "environment yjunction needs data.yjunction"),
        ("mocap", {"data": "of letters"}, "environment mocap has no data.letters"),
    ],
)
def test_a_section_that_lacks_or_does_not_belong(environment: str, changes: dict[str, object], sentence: str) -> None:
    others = {
        "of mocap": build_spec("bc", "mocap", "smoke").forecast,
        "of letters": build_spec("bc", "letters", "smoke").data,
    }
    changes = {name: others[value] if isinstance(value, str) else value for name, value in changes.items()}
    values = {**build_spec("bc", environment, "smoke").model_dump(), **changes}
    with pytest.raises(ValidationError, match=sentence):
        RunSpec.model_validate(values)


@pytest.mark.parametrize(
    ("environment", "override", "sentence"),
    [
        (
            "yjunction",
            "forecast.noise=0.1",
            "method bc on yjunction has no section 'forecast' to set in --set; it belongs to mocap, trajectories.",
        ),
        ("mocap", "data.yjunction.train=3", "environment mocap has no section 'data.yjunction' to set in --set."),
        ("letters", "data.yjunction.train=3", "environment letters has no section 'data.yjunction' to set in --set."),
        ("yjunction", "data.letters={word: A}", "environment yjunction has no section 'data.letters' to set in --set."),
        ("letters", "data.letters.word=ml", "data.letters.word: takes 1 to 6 capital letters A to Z, not 'ml'."),
        (
            "letters",
            "data.letters.word=NO",
            "data.letters.word: takes 1 to 6 capital letters A to Z; YAML reads NO, ON",
        ),
        (
            "letters",
            "data.letters.wrod=ML",
            "unknown key 'data.letters.wrod' in --set; did you mean data.letters.word?",
        ),
        ("mocap", "data.path=null", "environment mocap needs a data file; set data.path"),
        ("mocap", "forecast.observed=0", "forecast.observed = 0 in --set should be greater than or equal to 1."),
        (
            "mocap",
            "forecast.noise_on=some",
            "forecast.noise_on = some in --set should be 'all', 'history' or 'predictions'.",
        ),
    ],
)
def test_a_bad_override_is_one_sentence(environment: str, override: str, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        build_spec("bc", environment, "smoke", [override])
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_field_or_section_that_is_added_as_null_leaves_the_hash_as_it_was(environment: str) -> None:
    """So that runs that are stored go on being those of the spec; once it has a value the hash is another."""

    class Adversarial(specs.sections.AdversarialSpec):
        later: int | None

    class Later(RunSpec):
        adversarial: Adversarial | None
        football: specs.sections.ForecastSpec | None

    now = build_spec("gail", environment, "smoke")
    values = now.model_dump()
    values["adversarial"]["later"] = None
    values["football"] = None
    assert Later.model_validate(values).hash() == now.hash()
    assert Later.model_validate(values).as_json() != now.as_json()
    values["adversarial"]["later"] = 0
    assert Later.model_validate(values).hash() != now.hash()


def test_a_label_leaves_the_hash_of_runs_from_before_labels_as_it_was() -> None:
    """They had the identity without a name for it, and what is now an option switched off."""
    off = ("model.discriminator_waves=[]", "sac.expansion_steps=0", "sac.expansion_start=0", "sac.finite_horizon=false")
    off += ("sac.average=null", "adversarial.input_noise_final=1", "adversarial.input_noise_start=0")
    now = build_spec("ssail", "yjunction", "smoke", off)
    values = now.model_dump(mode="json", exclude_none=True)
    assert values["self_supervision"].pop("label") == "identity"
    assert values["model"].pop("initial_scale") == 0.1  # later keys too
    assert values["model"].pop("standardize") is False
    assert values["model"].pop("centre_relative") is False
    assert values["model"].pop("discriminator_waves") == []
    assert values["model"].pop("discriminator_velocities") is True
    assert values["self_supervision"].pop("discriminator_weight") == 1
    assert values["adversarial"].pop("reward") == "own"
    assert values["sac"].pop("expansion_steps") == 0
    assert values["sac"].pop("expansion_start") == 0
    assert values["sac"].pop("finite_horizon") is False
    assert values["adversarial"].pop("input_noise_final") == 1
    assert values["adversarial"].pop("input_noise_start") == 0
    before = json.dumps(values, sort_keys=True, separators=(",", ":"))
    assert now.hash() == hashlib.sha256(before.encode()).hexdigest()[:16]
    assert '"label":"identity"' in now.as_json()
    assert specs.with_added_keys(values)["self_supervision"]["label"] == "identity"
    other = build_spec("ssail", "yjunction", "smoke", ["self_supervision.label=zero-above-one"])
    assert other.hash() != build_spec("ssail", "yjunction", "smoke").hash()
    assert specs.with_added_keys(other.model_dump())["self_supervision"]["label"] == "zero-above-one"
    assert specs.with_added_keys({"self_supervision": None}) == {"self_supervision": None}


def test_stored_runs_of_nri_embed_step_by_step() -> None:
    """They have no key encoder_window, and their spec keeps its hash; the published form has another."""
    any_length = build_spec("nri", "mocap", "quick", ["variational.encoder_window=null"])
    values = any_length.model_dump(mode="json")
    del values["variational"]["encoder_window"]
    assert specs.spec_hash(values) == any_length.hash()
    assert RunSpec.model_validate(specs.with_added_keys(values)) == any_length
    published = build_spec("nri", "mocap", "quick")
    assert published.variational.encoder_window == published.forecast.observed == 50
    assert published.hash() != any_length.hash()
    assert build_spec("nri", "yjunction", "quick").variational.encoder_window is None


@pytest.mark.parametrize("method", ["nri", "dnri"])
def test_stored_runs_of_nri_and_dnri_are_unbounded_and_draw_each_edge(method: str) -> None:
    """They have no keys for that; every one of these, once it has another value, is another spec."""
    now = build_spec(method, "yjunction", "smoke")
    values = now.model_dump(mode="json")
    later = {"graph_noise": "edge", "graph_resample": "step", "action_step": None, "action_bound": None}
    assert {key: values["variational"].pop(key) for key in later} == later
    assert specs.spec_hash(values) == now.hash()
    assert RunSpec.model_validate(specs.with_added_keys(values)) == now
    changes = ("graph_noise=shared", "graph_resample=trajectory", "action_step=1")
    other = [build_spec(method, "yjunction", "smoke", [f"variational.{change}"]).hash() for change in changes]
    assert len({now.hash(), *other}) == 4


@pytest.mark.parametrize(
    ("method", "overrides", "sentence"),
    [
        ("ssail", ["adversarial.reward=probability"], "adversarial.reward probability is for gail alone, not ssail; "),
        ("wail", ["adversarial.reward=probability"], "adversarial.reward probability is for gail alone, not wail; "),
        ("dnri", ["variational.action_bound=3"], "bounds nothing without variational.action_step; set both"),
        ("dnri", ["variational.action_bound=1", "variational.action_step=2"], "is less than variational.action_step; "),
    ],
)
def test_settings_that_mean_nothing_together_are_refused(method: str, overrides: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build_spec(method, "yjunction", "smoke", overrides)
    assert build_spec("gail", "yjunction", "smoke", ["adversarial.reward=probability"]).adversarial.reward != "own"
    bounded = ["variational.action_bound=2", "variational.action_step=1"]
    assert build_spec("dnri", "yjunction", "smoke", bounded).variational.action_bound == 2


@pytest.mark.parametrize(
    ("given", "label"),
    [
        ("identity", "identity"),
        ("zero-above-one", "zero-above-one"),
        ("[[0,0],[1,1]]", ((0.0, 0.0), (1.0, 1.0))),
        ("[[-1,-1],[1,1],[1,0]]", ((-1.0, -1.0), (1.0, 1.0), (1.0, 0.0))),
    ],
)
def test_a_label_is_a_word_or_knots(given: str, label: object) -> None:
    made = build_spec("ssail", "yjunction", "smoke", [f"self_supervision.label={given}"])
    assert made.self_supervision is not None
    assert made.self_supervision.label == label
    assert RunSpec.model_validate_json(made.as_json()) == made


finite = st.floats(allow_nan=False, allow_infinity=False)


@given_by(st.lists(st.tuples(finite, finite), min_size=2, unique_by=lambda knot: knot[0]))
def test_knots_have_to_rise(knots: list[tuple[float, float]]) -> None:
    rising = sorted(knots)
    assert read_label([list(knot) for knot in rising]) == tuple(rising)
    if knots != rising:
        with pytest.raises(ValueError, match="sort them"):
            read_label(knots)


@given_by(st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=9), st.lists, max_leaves=9))
def test_anything_else_is_no_label(value: object) -> None:
    with contextlib.suppress(ValueError):
        found = read_label(value)
        assert isinstance(found, str | tuple)
        assert read_label(found) == found


def test_a_null_and_a_value_are_different_specs() -> None:
    """The limit of rewards is null on the Y-Junction."""
    made = {build_spec("gail", "yjunction", "smoke", [f"adversarial.reward_limit={v}"]).hash() for v in ("null", "1.0")}
    assert build_spec("gail", "yjunction", "smoke").hash() in made
    assert len(made) == 2


@pytest.mark.parametrize(
    ("given", "density", "pieces"),
    [
        ("[0,1]", (0.0, 1.0), ((0.0, 1.0, 1.0),)),
        ("[[-1,0,1],[0.5,1,3]]", ((-1.0, 0.0, 1.0), (0.5, 1.0, 3.0)), ((-1.0, 0.0, 1.0), (0.5, 1.0, 3.0))),
    ],
)
def test_alpha_is_a_range_or_weighted_ranges(given: str, density: object, pieces: object) -> None:
    """It survives JSON, where tuples are lists."""
    made = build_spec("ssail", "yjunction", "smoke", [f"self_supervision.alpha={given}"])
    assert made.self_supervision is not None
    assert (made.self_supervision.alpha, made.self_supervision.alpha_pieces) == (density, pieces)
    again = RunSpec.model_validate_json(made.as_json())
    assert again == made
    assert again.hash() == made.hash() != build_spec("ssail", "yjunction", "smoke").hash()


def test_the_hash_of_stored_values_is_that_of_the_spec() -> None:
    for method, environment in (("ssail", "yjunction"), ("dnri", "mocap"), ("gail", "letters")):
        spec = build_spec(method, environment, "smoke")
        stored = json.loads(spec.as_json())
        assert spec_hash(stored) == spec.hash()
        older = {**stored, "data": {key: value for key, value in stored["data"].items() if key != "letters"}}
        assert (spec_hash(older) == spec.hash()) is (environment != "letters")
        stored["evaluation"]["samples"] += 1
        assert spec_hash(stored) != spec.hash()
