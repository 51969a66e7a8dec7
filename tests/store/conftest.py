from collections.abc import Iterator
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.store import RunWriter, Store
from tests.store.postgres_server import Server


@pytest.fixture
def spec() -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke")


@pytest.fixture
def writer(store: Store, spec: RunSpec) -> RunWriter:
    """Of a running run with seed 0."""
    return store.start_run(spec, 0, dataset_hash="d" * 64, device="cpu")


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A PostgreSQL server, for the tests of this process."""
    running = Server()
    yield running
    running.close()


@pytest.fixture
def database(server: Server) -> str:
    """The name of an empty database on the server."""
    return server.new_database()


@pytest.fixture
def url(server: Server, database: str) -> str:
    """The URL of that database, with the password."""
    return server.url(database)


@pytest.fixture
def remote(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """A store on the server; its checkpoints are below the test's folder."""
    monkeypatch.chdir(tmp_path)
    opened = Store.open(url)
    yield opened
    opened.close()
