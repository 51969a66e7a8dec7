"""The registry: every name and alias leads to a module, and importing it is cheap."""

import subprocess
import sys
from pathlib import Path

import pytest

from ssmail.config.experiments_file import load_experiments
from ssmail.paper import results
from ssmail.paper.results import FIGURES
from ssmail.plots import style


def test_names_and_aliases_lead_to_the_same_figure() -> None:
    assert {name: module.name for name, module in FIGURES.items()} == {
        "fig1": "fig1",
        "landscapes": "fig1",
        "fig2": "fig2",
        "vector-field": "fig2",
        "fig3": "fig3",
        "curricula": "fig3",
        "fig4": "fig4",
        "stability": "fig4",
        "fig5": "fig5",
        "modes": "fig5",
        "fig6": "fig6",
        "beta": "fig6",
        "fig7": "fig7",
        "noise": "fig7",
        "fig8": "fig8",
        "alpha": "fig8",
        "fig9": "fig9",
        "yjunction": "fig9",
    }
    folder = Path(results.__file__).parent
    assert {f"{module.stem}.py" for module in FIGURES.values()} == {path.name for path in folder.glob("fig[0-9]*.py")}


def test_every_figure_of_experiments_yaml_can_be_drawn() -> None:
    assert set(load_experiments().figures) == {module.name for module in FIGURES.values()}


def test_importing_the_registry_imports_nothing_heavy() -> None:
    heavy = ("matplotlib", "pandas", "numpy", "sqlalchemy")
    code = f"import sys, ssmail.paper.results; print([module for module in {heavy} if module in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "labels", [["ssail"], ["ssail", "gail", "wail"], ["ssail a", "ssail b"], ["ssail", "new"], [*"abcdefghij"]]
)
def test_groups_are_told_apart(labels: list[str]) -> None:
    strokes = style.strokes(labels)
    assert list(strokes) == labels
    assert len(set(strokes.values())) == len(labels)
    assert all(strokes[label] == style.METHODS[label] for label in labels if label in style.METHODS)
