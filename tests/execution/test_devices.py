"""GPUs without a GPU: the list of devices is a planted one, and the worker processes say which one they were given."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from ssmail.execution import devices
from ssmail.execution.cells import Cell, RunSettings
from ssmail.execution.devices import also_on, least_used, places
from ssmail.execution.local import run_cells
from ssmail.store import Store
from tests.execution.fake_loop import Walk
from tests.execution.one_cell import run_cell

# Says which device it has; but first waits until `most` processes have begun, and looks whether any shares its device.
WORKER = """
import json, os, sys, time
job = json.loads(sys.stdin.readline())
device, seed, (folder, most) = job["settings"]["device"], job["seeds"][0], sys.argv[1:]
try:
    os.mkdir(f"{folder}/{device}")
except FileExistsError:
    device += " shared"
open(f"{folder}/seed {seed}", "w").close()
deadline = time.monotonic() + 60
while sum("seed" in name for name in os.listdir(folder)) < int(most) and time.monotonic() < deadline:
    time.sleep(0.01)
message = device if time.monotonic() < deadline else "alone"
if "shared" not in device:
    os.rmdir(f"{folder}/{device}")
event = {"kind": "failed", "run_id": None, "epoch": 0, "epochs": 4, "metrics": {}, "bad_input": False}
print(json.dumps({"seed": seed, "message": message, **event}), flush=True)
"""


@pytest.fixture(autouse=True)
def _two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "visible_gpus", lambda: ["cuda:0", "cuda:1"])


def test_places() -> None:
    assert places("cpu", 3) == []
    assert places("cuda") == ["cuda:0", "cuda:1"]
    assert places("cuda", 2) == ["cuda:0", "cuda:1"] * 2
    assert places("cuda:1", 2) == ["cuda:1"] * 2


def test_the_least_used_place_is_next() -> None:
    assert least_used(["cuda:0", "cuda:1"], []) == "cuda:0"
    assert least_used(["cuda:0", "cuda:1"], ["cuda:0"]) == "cuda:1"
    assert least_used(["cuda:0", "cuda:1"] * 2, ["cuda:0", "cuda:1", "cuda:1"]) == "cuda:0"


def computed_on(
    store: Store, cells: list[Cell], folder: Path, device: str, most: int, jobs: int = 4, per_device: int = 1
) -> list[str]:
    """The device of each cell, by processes of which `most` run at once."""
    folder.mkdir()
    command = (sys.executable, "-c", WORKER, str(folder), str(most))
    events = run_cells(
        cells,
        store_url=store.url,
        on_event=lambda _: None,
        jobs=jobs,
        device=device,
        per_device=per_device,
        worker=command,
    )
    return [event.message for event in events]


def test_processes_share_the_devices_and_are_no_more_than_fit(
    store: Store, cells: list[Cell], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = computed_on(store, cells, tmp_path / "one each", "cuda", most=2)
    assert (found[:2], set(found)) == (["cuda:0", "cuda:1"], {"cuda:0", "cuda:1"})
    assert caplog.messages == ["2 runs at once on 2 GPUs; --per-device allows more"]
    caplog.clear()
    found = computed_on(store, cells, tmp_path / "two each", "cuda", most=4, per_device=2)
    assert sorted(found) == ["cuda:0", "cuda:0 shared", "cuda:1", "cuda:1 shared"]
    assert computed_on(store, cells[:1], tmp_path / "named", "cuda:1", most=1, jobs=1) == ["cuda:1"]
    assert sorted(computed_on(store, cells, tmp_path / "cpu", "cpu", most=4)) == ["cpu", *["cpu shared"] * 3]
    assert caplog.messages == []


def run(cell: Cell, store: Store, device: str, stop_after: int = 99) -> Any:
    events: list[Any] = []
    run_cell(cell, store, RunSettings(device), events.append, lambda: len(events) > stop_after, Walk)
    return store.runs()[-1]


def test_a_run_says_where_it_was_computed_and_whether_that_repeats(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    row = run(cells[0], store, "cuda:1", stop_after=1)
    assert (row.device, row.deterministic) == ("cuda:1", False)
    row = run(cells[0], store, "cpu")
    assert (row.device, row.deterministic) == ("cuda:1, cpu", False)  # a part of it was computed on a GPU
    row = run(cells[1], store, "cpu", stop_after=1)
    assert (row.device, row.deterministic) == ("cpu", True)
    assert run(cells[1], store, "cpu").device == "cpu"


def test_only_the_last_attempt_counts_if_nothing_is_left_of_the_others(
    store: Store, cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    run(cells[0], store, "cuda:0", stop_after=0)
    row = run(cells[0], store, "cpu")
    assert (row.device, row.deterministic) == ("cpu", True)


def test_many_devices_fit_the_column() -> None:
    names = "cpu"
    for number in range(40):
        names = also_on(names, f"cuda:{number}")
        assert len(names) <= 64
        assert names.startswith("cpu, cuda")


def test_show_says_both(store: Store, cells: list[Cell], capsys: pytest.CaptureFixture[str]) -> None:
    from ssmail_cli.main import run as command

    row = run(cells[0], store, "cpu")
    assert command(["runs", "show", row.id, "--db", store.where, "--format", "csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"run,device,,cpu", "run,deterministic,,True"} <= set(lines)
