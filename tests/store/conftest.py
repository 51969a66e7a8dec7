import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.store import RunWriter, Store


@pytest.fixture
def spec() -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke")


@pytest.fixture
def writer(store: Store, spec: RunSpec) -> RunWriter:
    """Of a running run with seed 0."""
    return store.start_run(spec, 0, dataset_hash="d" * 64, device="cpu")
