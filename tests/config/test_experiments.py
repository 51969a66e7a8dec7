"""experiments.yaml -> specs: the order of the layers, and one sentence for everything a user can get wrong."""

import contextlib
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.config import strict_yaml
from ssmail.config.experiments import FigureRequirements, ablation, build_spec, figure_requirements
from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE, load_experiments
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError

from .experiments_file import SHIPPED, write


def quick(*overrides: str) -> RunSpec:
    return build_spec("ssail", "yjunction", "quick", overrides)


def complaint(*overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        quick(*overrides)
    return str(caught.value)


def test_each_layer_wins_over_the_ones_before_it(tmp_path: Path) -> None:
    layers: dict[str, dict[str, object]] = {
        "environments": {"yjunction": {"sac": dict.fromkeys(("gamma", "polyak", "graph_entropy", "temperature"), 0.1)}},
        "methods": {"ssail": {"sac": {"polyak": 0.2, "graph_entropy": 0.2, "temperature": 0.2}}},
        "profiles": {"quick": {"sac": {"graph_entropy": 0.3, "temperature": 0.3}}},
    }
    file = write(tmp_path / "e.yaml", **layers)
    spec = build_spec("ssail", "yjunction", "quick", ["sac.temperature=0.4"], file)
    assert (spec.sac.gamma, spec.sac.polyak, spec.sac.graph_entropy, spec.sac.temperature) == (0.1, 0.2, 0.3, 0.4)
    defaults = SHIPPED.defaults["sac"]
    assert spec.sac.target_entropy == defaults["target_entropy"]  # an untouched neighbour keeps its default


def test_a_profile_may_speak_to_one_method_or_environment_after_its_own_keys(tmp_path: Path) -> None:
    profile = {
        "sac": {"gamma": 0.1, "polyak": 0.1, "temperature": 0.1},
        "environments": {"yjunction": {"sac": {"polyak": 0.2, "temperature": 0.2}}},
        "methods": {"ssail": {"sac": {"temperature": 0.3}}},
    }
    spec = build_spec("ssail", "yjunction", "quick", (), write(tmp_path / "e.yaml", profiles={"quick": profile}))
    assert (spec.sac.gamma, spec.sac.polyak, spec.sac.temperature) == (0.1, 0.2, 0.3)


def test_the_last_override_wins_and_neighbours_survive() -> None:
    spec = quick("curriculum.beta=0.5", "curriculum={beta: 0.25}")
    assert spec.curriculum.beta == 0.25
    assert spec.curriculum.name == quick().curriculum.name


@settings(max_examples=25)
@given(st.floats(min_value=0.0, max_value=1.0))
def test_any_float_survives_the_way_through_an_override(value: float) -> None:
    assert quick(f"curriculum.beta={value!r}").curriculum.beta == value


@pytest.mark.parametrize("text", ["1e-3", "0.001", "1.0E-3", "+1e-3", "1.e-3"])
def test_every_way_to_write_a_float_gives_the_same_spec(text: str) -> None:
    assert quick(f"sac.actor_learning_rate={text}").hash() == quick("sac.actor_learning_rate=0.001").hash()


def test_a_whole_number_is_a_float_and_gives_the_same_spec() -> None:
    assert quick("sac.temperature=1").hash() == quick("sac.temperature=1.0").hash() != quick("sac.temperature=2").hash()


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("sac.gama=0.9", "unknown key 'sac.gama' in --set; did you mean sac.gamma?"),
        ("gamma=0.9", "unknown key 'gamma' in --set; did you mean sac.gamma?"),
        ("sca.gama=0.9", "unknown key 'sca.gama' in --set; did you mean sac.gamma?"),
        ("adversarial.gamma=0.9", "unknown key 'adversarial.gamma' in --set; did you mean sac.gamma?"),
        ("sac.gamma.x=1", "unknown key 'sac.gamma.x' in --set; did you mean sac.gamma?"),
        (
            "curriculum.zzz=1",
            "unknown key 'curriculum.zzz' in --set; choose from curriculum.name, "
            "curriculum.beta, curriculum.rate, curriculum.decay, curriculum.half_life, curriculum.steepness.",
        ),
        ("sac.gamma=abc", "sac.gamma = abc in --set should be a number."),
        ("sac.gamma='0.9'", "sac.gamma = '0.9' in --set should be a number."),
        ("training.epochs=1.5", "training.epochs = 1.5 in --set should be a whole number."),
        ("training.epochs=true", "training.epochs = true in --set should be a whole number."),
        ("sac.automatic_temperature=1", "sac.automatic_temperature = 1 in --set should be true or false."),
        ("data.path=3", "data.path = 3 in --set should be text."),
        ("curriculum.beta=-0.1", "curriculum.beta = -0.1 in --set should be greater than or equal to 0."),
        (
            "curriculum.name=forcing",
            "curriculum.name = forcing in --set should be 'none', 'trajectory-forcing', 'teacher-forcing' or "
            "'scheduled-sampling'.",
        ),
        ("sac.temperature=.inf", "sac.temperature = .inf in --set should be a finite number."),
        (
            "self_supervision.alpha=[3,1]",
            "self_supervision.alpha: the range from 3 to 1 ends before it begins; swap them.",
        ),
        *(
            (
                f"self_supervision.alpha={wrong}",
                "self_supervision.alpha: takes a range [low, high], or weighted ranges [[low, high, weight], ...].",
            )
            for wrong in ("0.5", "[]", "[0]", "[0,1,2]", "[[0,1]]", "[[0,1,1],2]", "[true,1]", "[.nan,1]", "[a,b]")
        ),
        (
            "self_supervision.alpha=[[0,1,0]]",
            "self_supervision.alpha: the weight 0 of the range from 0 to 1 is not above 0.",
        ),
        *(
            (
                f"self_supervision.label={wrong}",
                "self_supervision.label: takes identity, zero-above-one, two knots [[alpha, label], ...] or more, or "
                "module:function.",
            )
            for wrong in (
                "null",
                "1",
                "identiy",
                "a:b:c",
                "[]",
                "[[0,0]]",
                "[[0,0],1]",
                "[[0,0,0],[1,1,1]]",
                "[[0,.nan],[1,1]]",
            )
        ),
        (
            "self_supervision.label=[[0,0],[1,1],[0.5,1]]",
            "self_supervision.label: the knot at alpha 0.5 comes after the one at 1; sort them.",
        ),
        (
            "self_supervision.label=[[0,0],[1,0],[1,1],[1,2]]",
            "self_supervision.label: more than two knots at alpha 1; two of them make a jump.",
        ),
        ("sac=3", "sac = 3 in --set is a section, not a value; set one of its keys such as sac.gamma."),
        ("method=gail", "'method' in --set cannot be set there; give it with --method."),
        ("environment=x", "'environment' in --set cannot be set there; give it with --env."),
        ("sac.gamma", "--set takes key.path=value, not 'sac.gamma'; for example --set sac.gamma=0.9."),
        ("=1", "--set takes key.path=value, not '=1'; for example --set sac.gamma=0.9."),
        ("sac.gamma=[1,", "the value of --set sac.gamma=[1, is not valid YAML; put quotes around text."),
    ],
)
def test_a_bad_override_is_one_sentence(override: str, sentence: str) -> None:
    assert complaint(override) == sentence


KEYS = st.sampled_from(["sac.gamma", "sac", "data.path", "model.hidden", "curriculum.name", "nothing", "", "a..b"])


@settings(max_examples=50)
@given(KEYS, st.one_of(st.text(max_size=20), st.from_regex(r"[\[{&*!|>'-]{1,3}[a-z1.:, ]{0,4}[\]}]?", fullmatch=True)))
def test_no_override_ends_in_anything_but_a_spec_or_an_input_error(key: str, value: str) -> None:
    with contextlib.suppress(InputError):
        assert isinstance(quick(f"{key}={value}"), RunSpec)


@pytest.mark.parametrize(
    ("cell", "sentence"),
    [
        (("ssial", "yjunction", "quick"), "unknown method 'ssial'; did you mean ssail?"),
        (("ssail", "y-junction", "quick"), "unknown environment 'y-junction'; did you mean yjunction?"),
        (("ssail", "yjunction", "qiuck"), "unknown profile 'qiuck'; did you mean quick?"),
        (("ssail", "yjunction", "zzz"), "unknown profile 'zzz'; choose from smoke, quick, standard, paper."),
    ],
)
def test_a_misspelt_name_is_met_with_the_nearest(cell: tuple[str, str, str], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        build_spec(*cell)
    assert str(caught.value) == sentence


def test_an_unknown_key_in_the_file_names_its_section(tmp_path: Path) -> None:
    file = write(tmp_path / "mine.yaml", profiles={"quick": {"sac": {"gama": 1}}})
    with pytest.raises(InputError) as caught:
        build_spec("ssail", "yjunction", "quick", (), file)
    expected = "unknown key 'sac.gama' in profiles.quick of mine.yaml; did you mean sac.gamma?"
    assert str(caught.value) == expected


def test_a_missing_default_is_named(tmp_path: Path) -> None:
    defaults = {**SHIPPED.defaults, "curriculum": {"name": "none"}}
    file = write(tmp_path / "e.yaml", defaults=defaults)
    with pytest.raises(InputError, match=r"e\.yaml gives no value for curriculum\.beta"):
        build_spec("ssail", "yjunction", "quick", (), file)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("defaults: {a: 1}\nmethods: [1,\n", r"bad\.yaml, line 3 is not valid YAML: "),
        ("defaults: {}\ndefaults: {}\n", r"bad\.yaml, line 2 is not valid YAML: 'defaults' is given twice\."),
        ("- 1\n", r"bad\.yaml contains no mapping; it needs the sections defaults, "),
        ("default: {}\n", r"unknown section 'default' in .*bad\.yaml; did you mean defaults\?"),
        ("defaults: {}\n", r"section 'environments' of .*bad\.yaml is missing or no mapping"),
        ("\x00", r"bad\.yaml is not valid YAML: "),
    ],
)
def test_a_broken_file_is_named_with_its_line(tmp_path: Path, text: str, pattern: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=pattern) as caught:
        load_experiments(file)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "latin.yaml").write_bytes(b"\xff\xfe\x00\xe9")
    for name, pattern in (("absent.yaml", "No such file"), ("latin.yaml", "not UTF-8"), ("", "directory")):
        with pytest.raises(InputError, match=pattern):
            load_experiments(tmp_path / name)


def test_the_environment_variable_replaces_the_shipped_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = write(tmp_path / "mine.yaml", environments={"yjunction": {"sac": {"gamma": 0.125}}})
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(mine))
    assert quick().sac.gamma == 0.125
    assert load_experiments().path == mine
    assert load_experiments(SHIPPED.path).path == SHIPPED.path  # an explicit file wins


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"methods": ["ssail"]}, "figures.fig6 of e.yaml needs an environment, and either methods or an ablation"),
        ({"environment": "yjunction"}, "figures.fig6 of e.yaml needs an environment, and either methods or an "),
        ({"environment": "yjunction", "ablation": "bta"}, "unknown ablation 'bta'; did you mean beta?"),
        ({"environment": "moon", "ablation": "beta"}, "unknown environment 'moon'; "),
    ],
)
def test_a_wrong_figure_in_the_file_is_one_sentence(tmp_path: Path, entry: dict[str, Any], sentence: str) -> None:
    file = write(tmp_path / "e.yaml", figures={"fig6": entry})
    with pytest.raises(InputError) as caught:
        figure_requirements("fig6", file)
    assert str(caught.value).startswith(sentence)


def test_a_figure_names_its_runs() -> None:
    assert figure_requirements("fig4") == FigureRequirements("yjunction", ("ssail", "gail", "wail"))
    assert figure_requirements("fig6") == FigureRequirements("yjunction", ("ssail",), "beta")
    assert ablation("alpha").environment == "mocap"  # figure 2 draws it elsewhere
    assert figure_requirements("fig2") == FigureRequirements("letters", ("ssail",), "alpha")
    with pytest.raises(InputError, match=r"unknown figure 'figg5'; did you mean fig5\?"):
        figure_requirements("figg5")


def test_a_file_is_parsed_once_until_its_content_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = []
    parse = strict_yaml.parse_bytes

    def counting(content: bytes, path: Path) -> Any:
        parsed.append(path)
        return parse(content, path)

    monkeypatch.setattr(strict_yaml, "parse_bytes", counting)
    file = write(tmp_path / "e.yaml")
    for _ in range(3):
        assert figure_requirements("fig4", file).environment == "yjunction"
        assert build_spec("ssail", "yjunction", "smoke", (), file).sac.gamma != 0.5
    assert parsed == [file]
    times = file.stat()
    content = file.read_text()
    before = f"gamma: {SHIPPED.defaults['sac']['gamma']}"
    assert content.count(before) == 1
    file.write_text(content.replace(before, "gamma: 0.50"))  # as long as before
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert file.stat().st_size == times.st_size
    assert build_spec("ssail", "yjunction", "smoke", (), file).sac.gamma == 0.5
    assert parsed == [file, file]
