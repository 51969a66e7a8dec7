"""Without the packages of the extra, each adapter says what to install."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from ssmail.adapters.imitation_format import read_imitation, write_imitation
from ssmail.data.trajectories import Trajectories
from ssmail.errors import InputError

HOW = r"is not installed; run `pip install 'ssmail\[adapters\]'`"


@pytest.mark.parametrize("package", ["gymnasium.spaces", "pettingzoo"])
def test_the_environment_names_the_package(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.delitem(sys.modules, "ssmail.adapters.parallel_env", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"(gymnasium|{package}).* {HOW}"):
        importlib.import_module("ssmail.adapters.parallel_env")


def test_imitation_s_format_names_the_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    still = np.zeros((1, 3, 1, 2))
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(InputError, match=f"datasets.* {HOW}"):
        write_imitation(Trajectories.single_mode(still, still), tmp_path / "set")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=f"pyarrow.* {HOW}"):
        read_imitation(tmp_path)
