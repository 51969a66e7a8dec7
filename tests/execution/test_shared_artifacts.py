"""Runs whose checkpoints are where every machine reaches them: continued by another one, with the same numbers."""

import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import fsspec
import pytest

from ssmail.errors import InputError
from ssmail.execution import Resume
from ssmail.execution.cells import Cell, Event, Job, RunSettings
from ssmail.execution.local import run_cells
from ssmail.store import RunState, Store
from ssmail.store.artifact_storage import ArtifactStorage
from ssmail.store.maintenance.checks import check
from tests.execution.fake_loop import Accidents, Diverges, Walk
from tests.execution.fake_worker import fake_worker
from tests.execution.one_cell import run_cell
from tests.execution.recorded import recorded
from tests.store.databases import files

ROOT = Path(__file__).parents[2]


@pytest.fixture
def place(tmp_path: Path) -> str:
    return str(tmp_path / "shared")


@pytest.fixture
def undisturbed(cells: list[Cell], tmp_path: Path) -> tuple[Any, ...]:
    """What an uninterrupted run of seed 0 records, with its checkpoints beside the database."""
    store = Store.open(tmp_path / "undisturbed" / "ssmail.db")
    run_cell(cells[0], store, RunSettings(), lambda _: None, lambda: False, Walk)
    return recorded(store, store.runs()[0].id)


def run(cell: Cell, store: Store, stop_after: int = 99, loop: Any = Walk, resume: Resume = Resume.AUTO) -> list[Event]:
    events: list[Event] = []
    settings = RunSettings(resume=resume)
    last = run_cell(cell, store, settings, events.append, lambda: len(events) > stop_after, loop)
    return [*events, last]


def elsewhere(store: Store, tmp_path: Path, artifacts: str | None) -> Store:
    """The database as another machine has it: with the same content, and nothing beside it."""
    store.close()
    moved = tmp_path / uuid.uuid4().hex
    moved.mkdir()
    for file in Path(store.where).parent.glob("ssmail.db*"):
        shutil.copy(file, moved)
    return Store.open(moved / "ssmail.db", stale_seconds=0.001, artifacts=artifacts)


KILLED = """
import sys
from ssmail.config.experiments import build_spec
from ssmail.execution.cells import Cell, RunSettings
from ssmail.store import Store
from tests.execution.fake_loop import Accidents
from tests.execution.one_cell import run_cell

cell = Cell(build_spec("bc", "yjunction", "smoke", ["training.epochs=4"]), 2)
run_cell(cell, Store.open(sys.argv[1], artifacts=sys.argv[2]), RunSettings(), lambda _: None, lambda: False, Accidents)
"""


def test_a_killed_run_goes_on_in_another_folder(store: Store, cells: list[Cell], place: str, tmp_path: Path) -> None:
    whole = Store.open(tmp_path / "whole" / "ssmail.db")
    run(cells[2], whole)
    undisturbed = recorded(whole, whole.runs()[0].id)
    done = subprocess.run([sys.executable, "-c", KILLED, store.where, place], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    assert not store.checkpoint_root.exists()
    without = elsewhere(store, tmp_path, None)  # negative control
    there = elsewhere(store, tmp_path, place)
    events = run(cells[2], there)
    assert [event.kind for event in events] == ["resumed", *["epoch"] * 3, "finished"]
    assert events[0].epoch == 1
    assert recorded(there, there.runs()[0].id) == undisturbed
    assert undisturbed[2].keys() == {"best.pt", "last.pt"}
    assert len(files(Path(place))) == 2  # what the killed process recorded is superseded
    again = run(cells[2], without)
    assert (again[0].kind, again[0].epoch) == ("resumed", 0)
    assert again[0].message == "its checkpoint is not here, nor where --artifacts says, so it starts again"
    assert recorded(without, without.runs()[0].id)[:2] == undisturbed[:2]


@pytest.mark.parametrize("scheme", ["file", "memory"])
def test_an_interrupted_run_goes_on_through_a_url(
    scheme: str, store: Store, cells: list[Cell], undisturbed: tuple[Any, ...], tmp_path: Path
) -> None:
    url = f"memory://{uuid.uuid4().hex}" if scheme == "memory" else f"file://{tmp_path}/shared"
    run(cells[0], Store.open(store.where, artifacts=url), stop_after=2)
    there = elsewhere(store, tmp_path, url)
    assert run(cells[0], there, resume=Resume.REQUIRE)[0].epoch == 2
    assert recorded(there, there.runs()[0].id) == undisturbed


def test_a_run_that_began_with_files_goes_on_with_objects(
    store: Store, cells: list[Cell], undisturbed: tuple[Any, ...], place: str, tmp_path: Path
) -> None:
    run(cells[0], store, stop_after=2)
    with_objects = Store.open(store.where, artifacts=place)
    assert run(cells[0], with_objects, stop_after=0)[0].epoch == 2  # stores what it has loaded
    there = elsewhere(store, tmp_path, place)
    assert run(cells[0], there)[0].epoch == 2
    assert recorded(there, there.runs()[0].id) == undisturbed
    run(cells[0], with_objects)
    assert files(store.checkpoint_root) == {}  # superseded


def spoil(place: str, change: Callable[[bytes], bytes]) -> None:
    fs, root = fsspec.url_to_fs(place)
    for path in fs.find(root):
        fs.pipe_file(path, change(fs.cat_file(path)))


@pytest.mark.parametrize("change", [lambda content: content[:-1], lambda content: b"X" + content[1:]])
def test_an_altered_object_is_bad_input_and_leaves_the_run_alone(
    store: Store, cells: list[Cell], place: str, change: Callable[[bytes], bytes]
) -> None:
    shared = Store.open(store.where, artifacts=place)
    run(cells[0], shared, stop_after=1)
    (before,) = shared.runs()
    spoil(place, change)
    (event,) = run(cells[0], shared)
    assert event.bad_input
    assert event.message.startswith(f"the checkpoint {place}/{before.id}/")
    assert event.message.endswith(
        "has been altered since it was recorded; start afresh with --resume never, or delete the run"
    )
    assert shared.runs() == [before]


def test_starting_again_forgets_the_checkpoint_that_is_ahead(
    store: Store, cells: list[Cell], place: str, undisturbed: tuple[Any, ...]
) -> None:
    """Another process with the checkpoint would otherwise find it ahead of the metrics, and fail at each attempt."""
    shared = Store.open(store.where, artifacts=place)
    run(cells[0], shared, stop_after=2)
    assert run(cells[0], store, stop_after=0)[0].epoch == 0
    events = run(cells[0], shared)
    assert (events[0].epoch, events[-1].kind) == (0, "finished")
    assert recorded(shared, shared.runs()[0].id) == undisturbed


def test_a_diverged_run_keeps_its_objects(store: Store, cells: list[Cell], place: str) -> None:
    shared = Store.open(store.where, artifacts=place)
    run(cells[0], shared, loop=Diverges)
    (row,) = shared.runs()
    assert row.state is RunState.DIVERGED
    assert len(files(Path(place))) == 2
    assert recorded(shared, row.id)[2].keys() == {"best.pt", "last.pt"}


def test_a_place_that_cannot_be_written_to_ends_the_command_before_anything_is_trained(
    store: Store, cells: list[Cell], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match="file cannot be written to"):
        run_cells(cells, store_url=store.url, on_event=lambda _: None, artifacts=str(tmp_path / "file"))
    assert store.runs() == []


def test_the_place_reaches_a_worker_process_as_a_part_of_its_job(cells: list[Cell]) -> None:
    job = Job(cells[0].spec, (0,), "sqlite:////a.db", RunSettings(artifacts="ftp://me:SECRET@host/x"))
    assert Job.from_line(job.as_line()).settings.artifacts == "ftp://me:SECRET@host/x"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The URL of a bucket on a server that speaks S3, on this machine."""
    pytest.importorskip("s3fs", reason="needs s3fs: pip install s3fs")
    server = pytest.importorskip("moto.server", reason="needs an S3 server: pip install 'moto[server]'")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    running.start()
    host, port = running.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    name = f"bucket-{uuid.uuid4().hex[:8]}"
    fsspec.filesystem("s3").mkdir(name)
    yield f"s3://{name}/runs"
    running.stop()


@pytest.mark.slow
def test_processes_on_two_machines_share_a_bucket(
    bucket: str, store: Store, cells: list[Cell], undisturbed: tuple[Any, ...], tmp_path: Path
) -> None:
    assert list(Outcomes(cells[:1], store, bucket, Accidents).kinds) == ["finished"]
    assert recorded(Store.open(store.where, artifacts=bucket), store.runs()[0].id) == undisturbed
    assert list(Outcomes(cells[2:3], store, bucket, Accidents).kinds) == ["failed"]  # killed in its second epoch
    there = elsewhere(store, tmp_path, bucket)
    outcome = Outcomes(cells[2:3], there, bucket, Walk)
    assert outcome.said[:2] == [("loading", 0), ("resumed", 1)]
    assert list(outcome.kinds) == ["finished"]
    fs, root = fsspec.url_to_fs(bucket)
    fs.invalidate_cache()
    found = fs.find(root)
    assert len(found) == 4
    assert not there.checkpoint_root.exists()
    assert check(there.where, bucket) == []
    fs.pipe_file(found[0], b"nothing")
    (problem,) = check(there.where, bucket)
    assert "is altered" in problem.problem
    there.delete([row.id for row in there.runs()])
    fs.invalidate_cache()
    assert fs.find(root) == []
    with pytest.raises(InputError, match="cannot be written to"):
        ArtifactStorage("s3://no-such-bucket/runs").require_writable()
    assert not fs.exists("no-such-bucket")  # none is made


class Outcomes:
    """What `run_cells` says and returns of cells that worker processes compute with a loop."""

    def __init__(self, cells: Sequence[Cell], store: Store, place: str, loop: type) -> None:
        self.said: list[tuple[str, int]] = []
        events = run_cells(
            cells,
            store_url=store.url,
            on_event=lambda event: self.said.append((event.kind, event.epoch)),
            artifacts=place,
            worker=fake_worker(loop),
        )
        self.kinds = [event.kind for event in events]
