"""What an installation needs is declared, once, and an installed wheel works without the repository."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def name_of(requirement: str) -> str:
    """ "Foo_Bar[extra]>=1" -> "foo-bar"."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert found
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def imported(source: str) -> set[str]:
    """The packages that a module imports, wherever it does, but for those of Python and of ssmail itself."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names - sys.stdlib_module_names - {"ssmail", "ssmail_cli"}


def undeclared(sources: list[str], declared: set[str]) -> set[str]:
    """The imported packages of no declared distribution."""
    distributions = packages_distributions()
    used = set().union(*map(imported, sources))
    return {name for name in used if not {name_of(each) for each in distributions.get(name, [name])} & declared}


def test_every_imported_package_is_declared() -> None:
    files = [path for folder in ("src", "cli") for path in (ROOT / folder).rglob("*.py")]
    sources = [path.read_text("utf-8") for path in files]
    extras = PROJECT["optional-dependencies"]
    users = [
        *PROJECT["dependencies"],
        *(each for name, own in extras.items() if name not in ("dev", "docs") for each in own),
    ]
    declared = {"mlflow" if name_of(each) == "mlflow-skinny" else name_of(each) for each in users}
    assert undeclared(sources, declared) == set()
    assert undeclared(sources, declared - {"pillow", "markupsafe"}) == {"PIL", "markupsafe"}  # the test can fail


def test_constraints_pin_each_package_once() -> None:
    lines = (ROOT / "constraints.txt").read_text("utf-8").split()
    assert [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9A-Za-z.]*", line)] == []
    assert [name for name, count in Counter(map(name_of, lines)).items() if count > 1] == []


@pytest.mark.slow
def test_a_wheel_works_outside_the_repository(tmp_path: Path) -> None:
    """Built, installed with its dependencies into an environment of its own, and used in an empty folder."""
    settings = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SSMAIL_"))}

    def run(*command: object) -> str:
        words = [str(word) for word in command]
        done = subprocess.run(words, cwd=tmp_path, env=settings, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    run(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", "wheels", ROOT)
    (wheel,) = (tmp_path / "wheels").iterdir()
    run(python, "-m", "pip", "install", "--quiet", "--no-compile", "--constraint", ROOT / "constraints.txt", wheel)
    assert Path(run(python, "-c", "import ssmail; print(ssmail.__file__)").strip()).is_relative_to(tmp_path)
    ssmail = tmp_path / "venv" / "bin" / "ssmail"
    assert "finished" in run(ssmail, "train", "--profile", "smoke")
    assert "results/figures/fig5_modes.png" in run(ssmail, "plot", "fig5")
    assert run(python, "-m", "ssmail", "--version").startswith("ssmail ")
