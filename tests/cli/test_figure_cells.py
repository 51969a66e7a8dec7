"""The cells of figures."""

import pytest

from ssmail.config.experiments import ablation, build_spec
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError
from ssmail.execution.cells import Cell
from ssmail_cli.reproduce import figure_cells


def smoke(*overrides: str, method: str = "ssail") -> RunSpec:
    return build_spec(method, "yjunction", "smoke", overrides)


def test_a_figure_of_methods_needs_each_of_them_with_each_seed() -> None:
    cells = figure_cells("fig5", "smoke", [2, 0])
    assert cells == {
        Cell(smoke(method=method), seed): {"method": method, "seed": seed}
        for method in ("ssail", "dnri")
        for seed in (2, 0)
    }


def test_a_figure_of_an_ablation_needs_each_value_with_each_seed() -> None:
    cells = figure_cells("fig6", "smoke", [0, 1])
    assert [(cell.spec.curriculum and cell.spec.curriculum.beta, cell.seed) for cell in cells] == [
        (value, seed) for value in ablation("beta").values for seed in (0, 1)
    ]
    first = next(iter(cells.values()))
    assert first == {"method": "ssail", "curriculum.beta": 0.0, "seed": 0}


def test_ranges_are_named_as_they_are_written() -> None:
    cells = figure_cells("fig8", "smoke", [0])
    assert [names["self_supervision.alpha"] for names in cells.values()] == [[0, 1], [-1, 1]]
    assert {cell.spec.environment for cell in cells} == {"mocap"}
    elsewhere = figure_cells("fig2", "smoke", [0])
    assert [names["self_supervision.alpha"] for names in elsewhere.values()] == [[0, 1], [-1, 1]]
    assert {cell.spec.environment for cell in elsewhere} == {"letters"}


def test_figures_share_equal_cells() -> None:
    fig3, fig4, fig5, fig6 = (set(figure_cells(f"fig{number}", "quick", range(5))) for number in (3, 4, 5, 6))
    assert len(fig4 & fig5) == 5  # ssail
    assert len(fig3 & fig6) == 5  # trajectory forcing with the beta of the curriculum ablation
    assert not fig4 & (fig3 | fig6)  # at their own budget


def test_an_unknown_figure_or_profile() -> None:
    with pytest.raises(InputError, match="did you mean fig4"):
        figure_cells("fig44", "smoke", [0])
    with pytest.raises(InputError, match="did you mean smoke"):
        figure_cells("fig4", "smoky", [0])
