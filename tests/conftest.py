"""Settings for all tests: no timed asserts (two busy cores make any deadline a lie), one thread for each process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from ssmail.store import Store

settings.register_profile("ssmail", deadline=None)
settings.load_profile("ssmail")
torch.set_num_threads(1)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store in a folder of its own."""
    opened = Store.open(tmp_path / "results" / "ssmail.db")
    yield opened
    opened.close()
