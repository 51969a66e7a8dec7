"""Code that a stored spec names is not run, imported or looked for: whoever made the database chose the name."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from ssmail.config.experiments_file import ENVIRONMENT_VARIABLE
from ssmail.config.spec import RunSpec, spec_hash
from ssmail.execution.cells import Cell, RunSettings
from ssmail.store import RunState, Store
from tests.config.experiments_file import SHIPPED, write
from tests.execution.fake_loop import Walk
from tests.execution.one_cell import run_cell
from tests.hostile import harness
from tests.store.databases import SPEC, add, change

TRAP = "open(f'{__file__}.run', 'w').close()\ndef f(alpha):\n    return alpha\n"
DIGEST = hashlib.sha256(TRAP.encode()).hexdigest()[:12]
NAMES = (
    "ssmail_trap:f",
    "ssmail_trap.inside:f",
    f"ssmail_trap.inside:f@{DIGEST}",
    f"own_trap:f@{DIGEST}",
    "own_trap:f",
    "antigravity:fly",
    "idlelib.idle:main",
    "turtle:f",
)
READING = (
    "runs list",
    "runs list --figure fig6",
    "runs show {run}",
    "runs compare",
    "runs list --where self_supervision.label=identity --sort self_supervision.label",
    "plot ablation --key self_supervision.label --metric validation/mode_mse --out {folder}/figures",
    "runs export --out {folder}/all.csv",
    "db info",
    "db check",
    "db backup {folder}/backup.db",
    "db export --compact {folder}/compact.db",
    "claims",
    "plot fig6 --out {folder}/figures",
    "plot training --metric validation/mode_mse --group-by self_supervision.label --out {folder}/figures",
    "plot all --out {folder}/figures",
    "report --out {folder}/figures",
    "reproduce --dry-run --only fig6 --profile smoke",
    "train --dry-run --profile smoke",
)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a trap of each name in reach, and an experiments.yaml whose Figure 6 compares labels."""
    inside = tmp_path / "site" / "ssmail_trap"
    inside.mkdir(parents=True)
    here = tmp_path / "here"
    here.mkdir()
    for file in (inside / "__init__.py", inside / "inside.py", here / "own_trap.py", here / "ssmail_trap.py"):
        file.write_text(TRAP)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(here)
    figures = {**SHIPPED.figures, "fig6": {"environment": "yjunction", "ablation": "label"}}
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(write(here / "experiments.yaml", figures=figures)))
    return here


def database(path: Path, names: Sequence[str]) -> Path:
    """A database with two finished runs for each name, which only differ in the label; the first has the name as label.

    Each pair is a family that a figure can draw, and that is compared with experiments.yaml by its first run.
    """
    store = Store.open(path)
    for epochs, name in enumerate(names, start=2):
        for label in (name, "identity"):
            run = add(store, checkpoints={})
            spec = SPEC.model_dump(mode="json")
            spec["self_supervision"]["label"], spec["training"]["epochs"] = label, epochs
            change(
                path, "UPDATE run SET spec_json = ?, spec_hash = ? WHERE id = ?", json.dumps(spec), spec_hash(spec), run
            )
    store.close()
    return path


@pytest.mark.parametrize("command", READING)
def test_reading_drawing_judging_and_exporting_import_nothing_that_a_spec_names(home: Path, command: str) -> None:
    db = database(home / "from_a_stranger.db", NAMES)
    (run, *_) = Store.open(db).runs()
    words = command.format(run=run.id, folder=home).split()
    code, _, err = harness.hold(home, *words, "--db", db)
    assert code in (0, 3), err
    assert not list(home.parent.rglob("*.run"))


def test_neither_does_merging(home: Path) -> None:
    other = database(home / "from_a_stranger.db", NAMES)
    harness.hold(home, "db", "merge", other, "--db", home / "mine.db")
    harness.hold(home, "claims", "--db", home / "mine.db")


def test_a_figure_that_compares_labels_does_draw_them(home: Path) -> None:
    """The figure of the test above reaches the stored names."""
    db = database(home / "from_a_stranger.db", NAMES)
    harness.hold(home, "plot", "fig6", "--out", home / "figures", "--db", db)
    drawn = (home / "figures" / "fig6_beta.csv").read_text()
    assert any(name in drawn for name in NAMES)


def test_a_resumed_run_is_trained_with_the_users_spec_not_the_stored_one(home: Path) -> None:
    """A stranger can store any spec beside the hash of the one that the user trains."""
    db = home / "from_a_stranger.db"
    store = Store.open(db)
    run = add(store, 0, (), RunState.INTERRUPTED, checkpoints={})
    change(db, "UPDATE run SET spec_json = replace(spec_json, 'identity', 'ssmail_trap.inside:f')")
    trained = []

    def loop(spec: RunSpec, seed: int, device: str) -> Walk:
        trained.append(spec)
        return Walk(spec, seed, device)

    change(db, "UPDATE run SET dataset_hash = ?", Walk(SPEC, 0, "cpu").dataset_hash)
    with harness.watching(home) as watch:
        event = run_cell(Cell(SPEC, 0), store, RunSettings(), lambda _: None, lambda: False, loop)
    assert watch.wrong == []
    assert (event.kind, event.run_id, trained) == ("finished", run, [SPEC])
