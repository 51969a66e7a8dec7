"""Recorded motion in small: the specs of toy runs on a few windows of a skeleton of five joints."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from tests.data.mocap.handmade import write_set

ToySpec = Callable[..., RunSpec]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four windows of 10 frames to train on, three to validate with and three of 16 to test."""
    return write_set(tmp_path_factory.mktemp("recorded") / "mocap.npz")


@pytest.fixture(scope="session")
def toy(recorded: Path) -> ToySpec:
    """toy("dnri", "forecast.noise=0.1") -> the spec of a run of a second; six frames observed, ten predicted."""

    def spec(method: str, *overrides: str) -> RunSpec:
        given = [f"data.path={recorded}", "forecast.observed=6", "forecast.predicted=10", *overrides]
        return build_spec(method, "mocap", "smoke", given)

    return spec
