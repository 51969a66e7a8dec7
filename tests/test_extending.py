"""docs/extending.md is true: its example works beside an experiments.yaml, and its commands train with it."""

import re
import shlex
from pathlib import Path

import pytest

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.config.user_functions import UserFunction, search_folders
from ssmail.store import Store
from ssmail_cli.main import run

from .config.experiments_file import write

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text()
DENSITY = [[-1.0, 0.0, 1.0], [0.0, 1.5, 3.0]]


def block(language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)
    return str(found)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an experiments.yaml and the file of the example; commands are given in another one."""
    for name in ("home", "elsewhere"):
        (tmp_path / name).mkdir()
    code = block("python")
    assert code.startswith("# shaping.py\n")
    (tmp_path / "home" / "shaping.py").write_text(code)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(tmp_path / "home" / "experiments.yaml")))
    monkeypatch.setenv("SSMAIL_DB", str(tmp_path / "results" / "ssmail.db"))
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "home"


def test_the_example_trains_and_its_broken_brothers_do_not(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands = [shlex.split(line)[1:] for line in block("sh").splitlines()]
    assert [run(command) for command in commands] == [0, 0, 0], capsys.readouterr().err
    runs = Store.open(home.parent / "results" / "ssmail.db").runs()
    label = UserFunction("shaping", "steep").with_digest(search_folders())
    assert [run.spec["self_supervision"]["label"] for run in runs] == ["identity", label]  # the second has trained it
    assert {str(run.spec["self_supervision"]["alpha"]) for run in runs} == {str(DENSITY)}
    assert {run.state for run in runs} == {"finished"}
    capsys.readouterr()

    train = [*commands[1], "--dry-run"]
    assert (run(train), capsys.readouterr().out.splitlines()[1].split(",")[1]) == (0, "skip")
    file = home / "shaping.py"
    file.write_text(block("python").replace("2 - alpha", "3 - 2 * alpha"))
    assert (run(train), capsys.readouterr().out.splitlines()[1].split(",")[1]) == (0, "new")
    for right, wrong, said in (
        ("(alpha: torch.Tensor)", "(alpha, more)", "cannot be called"),
        ("2 - alpha", "0 * torch.log(-alpha)", "returns NaN or infinity for alpha 1"),
        ("towards = ", "towards = alpha.nothing + ", "raises AttributeError: "),
    ):
        assert right in block("python")
        file.write_text(block("python").replace(right, wrong))
        assert run(commands[1]) == 2
        (sentence,) = capsys.readouterr().err.splitlines()
        assert sentence.startswith(f"ssmail: self_supervision.label: the function shaping:steep {said}")
    assert len(Store.open(home.parent / "results" / "ssmail.db").runs()) == len(runs)


def test_the_text_names_what_there_is() -> None:
    for name in re.findall(r"`((?:\w+/)+\w+\.py|\w+\.py)`", TEXT):
        places = (ROOT, ROOT / "src" / "ssmail", ROOT / "cli")
        assert name == "shaping.py" or any((place / name).exists() for place in places), name
    assert "extending.md" in (ROOT / "README.md").read_text()
