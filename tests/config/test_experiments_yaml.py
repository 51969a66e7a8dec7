"""Every entry of the shipped experiments.yaml can be built."""

import itertools

import pytest

from ssmail.config.experiments import ablation_specs, build_spec, display_value, figure_requirements
from ssmail.config.experiments_file import load_experiments
from ssmail.config.names import ENVIRONMENTS, METHODS
from ssmail.config.spec import RunSpec

EXPERIMENTS = load_experiments()
CELLS = list(itertools.product(EXPERIMENTS.methods, EXPERIMENTS.environments, EXPERIMENTS.profiles))


@pytest.mark.parametrize(("method", "environment", "profile"), CELLS)
def test_every_entry_builds_a_spec(method: str, environment: str, profile: str) -> None:
    spec = build_spec(method, environment, profile)
    assert (spec.method, spec.environment, spec.profile) == (method, environment, profile)
    assert RunSpec.model_validate_json(spec.as_json()).hash() == spec.hash()


def test_no_two_entries_are_the_same_cell() -> None:
    assert len({build_spec(*cell).hash() for cell in CELLS}) == len(CELLS)


def test_the_file_names_every_method_and_environment() -> None:
    assert set(EXPERIMENTS.methods) == set(METHODS)
    assert set(EXPERIMENTS.environments) == set(ENVIRONMENTS)
    assert set(EXPERIMENTS.profiles) == {"smoke", "quick", "standard", "paper"}


@pytest.mark.parametrize("figure", EXPERIMENTS.figures)
def test_every_figure_names_runs_that_can_be_trained(figure: str) -> None:
    environment, methods, ablation = figure_requirements(figure)
    assert methods
    for method in methods:
        assert build_spec(method, environment, "quick").environment == environment
    assert ablation is None or ablation in EXPERIMENTS.ablations


@pytest.mark.parametrize("profile", EXPERIMENTS.profiles)
@pytest.mark.parametrize("name", EXPERIMENTS.ablations)
def test_every_value_of_every_ablation_builds_a_spec(name: str, profile: str) -> None:
    specs = ablation_specs(name, profile)
    assert [display_value(value) for value in specs] == EXPERIMENTS.ablations[name]["values"]
    assert len({spec.hash() for spec in specs.values()}) == len(specs)


def test_the_profiles_grow() -> None:
    epochs = [build_spec("ssail", "yjunction", profile).training.epochs for profile in ("smoke", "quick", "paper")]
    assert epochs == sorted(set(epochs))
