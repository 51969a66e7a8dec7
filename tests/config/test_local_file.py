"""Which experiments.yaml is in use: one rule, and what a file may not that was only found in the current folder."""

import logging
import shutil
from pathlib import Path

import pytest

from ssmail.config import experiments_file
from ssmail.config.experiments import build_spec
from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE, find_file, load_experiments, shipped_file
from ssmail.errors import InputError

from .experiments_file import SHIPPED, write


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, which is empty."""
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    experiments_file._announce.cache_clear()
    return tmp_path


def gamma() -> float:
    return float(build_spec("ssail", "yjunction", "quick").sac.gamma)


def test_the_file_of_the_current_folder_is_used_and_announced(here: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert (find_file(), gamma()) == (shipped_file(), 0.95)
    assert not caplog.messages
    mine = write(here / "experiments.yaml", environments={"yjunction": {"sac": {"gamma": 0.125}}})
    assert (find_file(), gamma(), gamma()) == (mine, 0.125, 0.125)
    assert caplog.messages == [f"{mine} of the current folder is in use, not the one of ssmail"]
    assert caplog.records[0].levelno == logging.WARNING


def test_a_file_that_is_asked_for_comes_first_and_needs_no_announcement(
    here: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(here / "experiments.yaml", environments={"yjunction": {"sac": {"gamma": 0.125}}})
    other = write(here / "other.yaml", environments={"yjunction": {"sac": {"gamma": 0.25}}})
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(other))
    assert (find_file(), gamma()) == (other, 0.25)
    assert load_experiments(shipped_file()).path == shipped_file()
    assert not caplog.messages


def test_the_shipped_file_is_not_local_in_its_own_folder(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shipped_file().parent)
    assert (find_file(), load_experiments().path) == (shipped_file(), shipped_file())
    assert not caplog.messages


def test_a_folder_of_that_name_is_not_passed_over(here: Path) -> None:
    (here / "experiments.yaml").mkdir()
    with pytest.raises(InputError, match=r"experiments\.yaml cannot be read: Is a directory"):
        load_experiments()


@pytest.mark.parametrize(
    "place",
    [
        {"defaults": {**SHIPPED.defaults, "self_supervision": {"label": "shaping:steep"}}},
        {"methods": {**SHIPPED.methods, "gail": {"self_supervision": {"label": "shaping:steep@0123456789ab"}}}},
        {
            "ablations": {"label": {**SHIPPED.ablations["label"], "values": ["identity", "shaping:steep"]}},
            "figures": {},
        },
        {"ablations": {"label": {"anything": [[{"deep": "a.b:c"}]]}}},
    ],
)
def test_it_may_not_name_python_code_unless_it_is_asked_for(
    here: Path, place: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = write(here / "experiments.yaml", **place)
    (here / "shaping.py").write_text("raise SystemExit")
    with pytest.raises(InputError, match=r"experiments\.yaml names Python code, (shaping:steep|a\.b:c)") as caught:
        load_experiments()
    assert str(caught.value).endswith("if it is yours, set SSMAIL_EXPERIMENTS=experiments.yaml.")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "experiments.yaml")
    assert load_experiments().path == Path(mine.name)


def test_a_copy_of_the_shipped_file_names_none(here: Path) -> None:
    shutil.copy(shipped_file(), here / "experiments.yaml")
    assert load_experiments().path == here / "experiments.yaml"
