"""`ssmail config`: where values come from, what keys mean, and an experiments.yaml of one's own."""

import json
from pathlib import Path

import pytest

from ssmail.config import experiments_file
from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import load_experiments, shipped_file
from ssmail.config.names import flatten
from ssmail.config.spec import spec_keys
from tests.cli.command_line import CommandLine


def layers(cli: CommandLine, *arguments: str) -> dict[str, tuple[str, str]]:
    return {row["key"]: (row["value"], row["layer"]) for row in cli("config", "show", *arguments).rows}


def test_every_value_has_the_layer_that_it_comes_from(cli: CommandLine) -> None:
    settings = ("--set", "sac={polyak: 0.5}", "--set", "sac.average=0.1")
    found = layers(cli, "--method", "gail", "--env", "letters", "--profile", "smoke", *settings)
    spec = build_spec("gail", "letters", "smoke", ["sac.polyak=0.5", "sac.average=0.1"])
    expected = {key for key, value in flatten(spec.model_dump()).items() if not spec_keys().get(key, True)}
    assert set(found) == expected
    assert found["sac.gamma"] == ("0.8", "environments.letters.methods.gail")
    assert found["adversarial.input_noise"] == ("0.1", "environments.letters.methods.gail")
    assert found["sac.polyak"] == ("0.5", "--set")
    assert found["sac.average"] == ("0.1", "--set")
    assert found["training.epochs"] == ("3", "profiles.smoke")
    assert found["training.decay_start"] == ("0.4", "environments.letters")
    assert found["model.edge_types"] == ("2", "defaults")
    assert found["model.first_type_is_none"] == ("false", "defaults")
    assert found["adversarial.reward_limit"] == ("null", "defaults")


def test_json_has_the_values_and_the_file(cli: CommandLine) -> None:
    told = json.loads(cli("config", "show", "model", "sac.gamma", "--env", "yjunction", "--json").out)
    spec = build_spec("ssail", "yjunction", "quick")
    assert (told["file"], told["spec_hash"]) == (str(load_experiments().path), spec.hash())
    values = {item["key"]: item["value"] for item in told["values"]}
    assert values.pop("sac.gamma") == 0.95
    assert values == flatten({"model": spec.model.model_dump(mode="json")})


def test_the_file_in_use_is_told(cli: CommandLine) -> None:
    assert cli("config", "show").err.strip().endswith(f"values of {shipped_file()}")


def test_keys_are_explained(cli: CommandLine) -> None:
    (row,) = cli("config", "keys", "sac.gamma").rows
    assert row == {
        "key": "sac.gamma",
        "type": "number",
        "unit": "per step",
        "range": "[0, 1)",
        "default": "0.95",
        "meaning": "Discount factor of the reward.",
    }
    assert len(cli("config", "keys").rows) == sum(not section for section in spec_keys().values())
    lines = cli("config", "keys", "sac.gamma", "--format", "table").out.splitlines()
    assert lines == ["sac.gamma: number, [0, 1), per step, default 0.95", "  Discount factor of the reward."]


@pytest.mark.parametrize("command", ["show", "keys"])
def test_an_unknown_key_is_a_sentence(cli: CommandLine, command: str) -> None:
    assert cli("config", command, "gamma").sentence == "unknown key 'gamma'; did you mean sac.gamma?"


def test_a_file_of_ones_own(cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    experiments_file._announce.cache_clear()
    assert cli("config", "init").out == "experiments.yaml\n"
    mine = tmp_path / "experiments.yaml"
    assert mine.read_bytes() == shipped_file().read_bytes()
    mine.write_text(mine.read_text().replace("gamma: 0.95", "gamma: 0.75"))
    assert cli("config", "init").sentence.startswith("experiments.yaml exists already; give --force")
    assert "0.75" in mine.read_text()
    shown = cli("config", "show", "sac.gamma")
    assert shown.rows[0]["value"] == "0.75"
    assert f"{mine} of the current folder is in use, not the one of ssmail" in shown.err
    assert cli("config", "init", "--force").code == 0
    assert mine.read_bytes() == shipped_file().read_bytes()
    assert cli("config", "init", "other/mine.yaml").err == "use it with SSMAIL_EXPERIMENTS=other/mine.yaml\n"


def test_a_file_that_cannot_be_written(cli: CommandLine, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    assert "cannot be written: File exists" in cli("config", "init", tmp_path / "taken" / "e.yaml").sentence
