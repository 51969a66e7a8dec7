"""A user's own function: where it is found, what it is known by, and every way in which it cannot be loaded."""

import os
import sys
from pathlib import Path

import pytest

from ssmail.config.experiments import ablation, ablation_specs, build_spec
from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE, PACKAGE
from ssmail.config.sections import required
from ssmail.config.spec import RunSpec
from ssmail.config.user_functions import MOST_BYTES, UserFunction, load_label, search_folders
from ssmail.errors import InputError

from .experiments_file import write


def named(text: str) -> UserFunction:
    found = UserFunction.parse(text)
    assert found is not None
    return found


def loaded(text: str, *folders: Path) -> object:
    return named(text).load(folders)(1)


def complaint(text: str, *folders: Path) -> str:
    with pytest.raises(InputError) as caught:
        named(text).load(folders)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("text", ["f", "a:b:c", "a.:f", ".a:f", "a b:f", "1a:f", "a:f@12", "a/b:f", "", 3, None])
def test_other_texts_name_no_function(text: object) -> None:
    assert UserFunction.parse(text) is None


def test_the_first_folder_wins(tmp_path: Path) -> None:
    first, second = tmp_path / "1", tmp_path / "2"
    for folder in (first, second):
        (folder / "nested").mkdir(parents=True)
        (folder / "own.py").write_text(f"def f(x):\n    return {folder.name}\n")
    (second / "nested" / "deep.py").write_text("from .other import g as f\n")
    (second / "nested" / "other.py").write_text("import beside_own\ndef g(x):\n    return beside_own.VALUE\n")
    (second / "beside_own.py").write_text("VALUE = 7\n")
    assert loaded("own:f", first, second) == 1
    assert loaded("own:f", second, first) == 2
    assert loaded("nested.deep:f", first, second) == 7
    assert "own" not in sys.modules


@pytest.mark.parametrize("text", ["keyword:iskeyword", "os.path:join", "trap.inside:f", "trap:f", "math:sin"])
def test_nothing_is_taken_from_the_installed_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    (tmp_path / "installed" / "trap").mkdir(parents=True)
    for name in ("__init__", "inside"):
        (tmp_path / "installed" / "trap" / f"{name}.py").write_text("def f(x):\n    return x\n")
    monkeypatch.syspath_prepend(tmp_path / "installed")
    file = f"{text.partition(':')[0].replace('.', '/')}.py"
    assert complaint(text, tmp_path) == f"{text}: there is no {file} in {tmp_path}; put it beside experiments.yaml."
    with pytest.raises(InputError, match="there is no "):
        named(text).with_digest([tmp_path])
    assert "trap" not in sys.modules


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    (outside / "package").mkdir(parents=True)
    for file in (outside / "away.py", outside / "package" / "deep.py", inside / "here.py"):
        file.write_text("def f(x):\n    return 3\n")
    (inside / "link.py").symlink_to(outside / "away.py")
    (inside / "package").symlink_to(outside / "package")
    (inside / "near.py").symlink_to("here.py")
    assert loaded("near:f", inside) == 3
    for name in ("link:f", "package.deep:f"):
        assert "is a link out of its folder; copy the file there instead." in complaint(name, inside)


def test_a_pipe_a_folder_and_a_huge_file_are_no_modules(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.py")
    (tmp_path / "folder.py").mkdir()
    (tmp_path / "huge.py").write_text("#" * (MOST_BYTES + 1))
    assert "there is no pipe.py" in complaint("pipe:f", tmp_path)
    assert "there is no folder.py" in complaint("folder:f", tmp_path)
    assert "huge.py has more than 1,000,000 bytes" in complaint("huge:f", tmp_path)
    assert "there is no aaa" in complaint(f"{300 * 'a'}:f", tmp_path)


def test_a_changed_file_is_another_function_however_fast_it_changed(tmp_path: Path) -> None:
    """Python's own compiled files tell changes within a second apart by their length alone."""
    file = tmp_path / "own.py"
    file.write_text("def f(x):\n    return 1\n")
    first = named("own:f").with_digest([tmp_path])
    assert loaded(first, tmp_path) == 1
    file.write_text("def f(x):\n    return 2\n")
    second = named("own:f").with_digest([tmp_path])
    assert first != second
    assert first.startswith("own:f@")
    assert loaded(second, tmp_path) == loaded("own:f", tmp_path) == 2
    assert "own.py has changed (digest " in complaint(first, tmp_path)
    file.write_bytes(b"def f(x):\r\n    return 2\r\n")
    assert named("own:f").with_digest([tmp_path]) == second


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("own:g", "def f(x): pass", "own.py has no function g; choose from f."),
        ("own:smoth", "def smooth(x): pass", "own.py has no function smoth; did you mean smooth?"),
        ("own:f", "f = 3", "own.py has no function f; define it there."),
        ("own:f", "def f(x:", "own.py cannot be imported, SyntaxError: "),
        ("own:f", "import nowhere_to_be_found", "own.py cannot be imported, ModuleNotFoundError: No module named "),
        ("own:f", "raise SystemExit('a\\nb')", "own.py cannot be imported, SystemExit: a b; correct it."),
        ("own:f", "\0", "own.py cannot be imported, "),
    ],
)
def test_a_file_that_cannot_be_used(tmp_path: Path, name: str, content: str, said: str) -> None:
    (tmp_path / "own.py").write_text(content)
    assert complaint(name, tmp_path).startswith(f"{name}: {tmp_path}/{said}")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    expected = f"there is no a/b.py in {tmp_path}; put it beside experiments.yaml."
    assert complaint("a.b:f", tmp_path) == f"a.b:f: {expected}"


# -- in a spec -----------------------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an experiments.yaml, with own.py beside it; the current folder is another one."""
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir()
    elsewhere.mkdir()
    (home / "own.py").write_text("def f(alpha):\n    return alpha\n")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(home / "mine.yaml")))
    monkeypatch.chdir(elsewhere)
    return home


def spec(label: str = "own:f") -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke", [f"self_supervision.label={label}"])


def test_a_changed_file_is_another_spec(home: Path) -> None:
    before = spec()
    label = required(before.self_supervision).label
    assert label == named("own:f").with_digest([home])
    assert spec(label) == before
    assert RunSpec.model_validate_json(before.as_json()) == before
    with (home / "own.py").open("a") as file:
        file.write("# changed\n")
    assert spec().hash() != before.hash()
    with pytest.raises(InputError, match=r"own\.py has changed"):
        spec(label)
    (home / "own.py").unlink()
    with pytest.raises(InputError, match=r"own:f: there is no own\.py in .*/home or .*/elsewhere; put"):
        spec()
    (Path.cwd() / "own.py").write_text("def f(alpha):\n    return alpha\n")
    assert spec() == before  # found in the current folder


def test_training_needs_the_digest_of_the_spec(home: Path) -> None:
    with pytest.raises(InputError, match=r"own:f names no digest"):
        load_label("own:f")
    with pytest.raises(InputError, match=r"own\.py has changed"):
        load_label("own:f@000000000000")
    assert load_label(named("own:f").with_digest([home])) is not None


def test_no_function_is_searched_for_in_ssmail_itself(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shipped experiments.yaml of an installation lies beside its modules."""
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(home / "mine.yaml")))
    assert search_folders() == (home, Path.cwd())
    assert search_folders(PACKAGE / "experiments.yaml") == (Path.cwd(),)


def test_a_removed_working_folder_is_one_sentence(home: Path) -> None:
    Path.cwd().rmdir()
    with pytest.raises(InputError, match="the current folder has been removed"):
        search_folders()


def test_values_of_an_ablation_may_be_words_knots_and_functions(home: Path) -> None:
    given = ["identity", "own:f", [[0, 0], [1, 1]]]
    specs = ablation_specs("label", "smoke", given)
    assert list(specs) == ["identity", named("own:f").with_digest([home]), ((0.0, 0.0), (1.0, 1.0))]
    assert len({found.hash() for found in specs.values()}) == 3
    entry = {"method": "ssail", "environment": "yjunction", "key": "self_supervision.label", "values": given}
    file = write(home / "mine.yaml", ablations={"mine": entry}, profiles={"smoke": {}}, figures={})
    assert ablation("mine", file=file).values == tuple(specs)
    (home / "own.py").unlink()
    assert ablation("mine", file=file).values[1] == "own:f"  # its runs can still be drawn
    with pytest.raises(InputError, match=r"there is no own\.py"):
        ablation_specs("mine", "smoke", file=file)
