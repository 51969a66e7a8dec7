"""--set and --values: any key, any YAML, and what is no YAML."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.config.names import ENVIRONMENTS, METHODS
from ssmail.config.spec import spec_keys
from tests.config.experiments_file import write
from tests.hostile.harness import cases, hold
from tests.hostile.odd_values import TEXTS, WORDS

KEYS = st.sampled_from(sorted(spec_keys()))
ODD_KEYS = (
    st.sampled_from(WORDS) | st.text(max_size=20) | KEYS.map(lambda key: f"{key}.more") | st.just("a." * 5000 + "a")
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an experiments.yaml of its own, and a module in reach that nobody may import."""
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(tmp_path / "experiments.yaml")))
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "ssmail_trap.py").write_text("def f(alpha):\n    return alpha\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(folder: Path, *words: str) -> list[str]:
    name, *rest = words
    return [name, "--dry-run", "--profile", "smoke", "--db", str(folder / "absent.db"), *rest]


@pytest.mark.parametrize("word", WORDS, ids=lambda word: repr(word[:20]))
def test_each_odd_word(folder: Path, word: str) -> None:
    for key in ("sac.gamma", "training.epochs", "self_supervision.label"):
        hold(folder, *command(folder, "train", "--set", f"{key}={word}"))
    hold(folder, *command(folder, "train", "--set", f"{word}=1"))
    hold(folder, *command(folder, "ablate", "label", f"--values=identity,{word}"))


@cases(60, 1200)
@given(key=KEYS, value=TEXTS, method=st.sampled_from(METHODS), environment=st.sampled_from(ENVIRONMENTS))
def test_a_value_of_a_key(folder: Path, key: str, value: str, method: str, environment: str) -> None:
    words = ("train", "--method", method, "--env", environment, "--set", f"{key}={value}")
    hold(folder, *command(folder, *words))


@cases(20, 600)
@given(key=ODD_KEYS, equals=st.sampled_from(["=", "", "==", " = "]), value=TEXTS)
def test_a_key_that_there_is_not(folder: Path, key: str, equals: str, value: str) -> None:
    code, _, _ = hold(folder, *command(folder, "train", "--set", f"{key}{equals}{value}"))
    assert code == 2 or key in spec_keys()


@cases(30, 1000)
@given(
    name=st.sampled_from(["alpha", "beta", "curriculum", "label"]) | st.sampled_from(WORDS),
    values=st.lists(TEXTS, min_size=1, max_size=3).map(",".join),
)
def test_values_of_an_ablation(folder: Path, name: str, values: str) -> None:
    hold(folder, *command(folder, "ablate", f"--values={values}", "--", name))
