"""The data files that the runs of a reproduction read: made where possible, and missed before anything is trained."""

import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ssmail.errors import InputError
from ssmail_cli.display import note
from ssmail_cli.mocap import prep_mocap
from ssmail_cli.progress import Sweep

if TYPE_CHECKING:
    from ssmail.execution.cells import Cell
    from ssmail.store import Store

MOCAP = "mocap"


class DataFiles(NamedTuple):
    """What is the matter with the data of some figures, by figure: `made` is going to be there, `missing` is not.

    Each is a sentence without a full stop.
    """

    made: dict[str, str]
    missing: dict[str, str]


def look_for_data(figures: Mapping[str, Sweep], cmu: Path | None) -> DataFiles:
    """Which figures need a file that is not there. `cmu`: the files of the CMU database, for a set of recorded walking.

    Raises InputError when there is no such folder or zip file.
    """
    found = DataFiles({}, {})
    for name, sweep in figures.items():
        for path, environment in sorted(_absent(sweep)):
            if environment != MOCAP:
                found.missing[name] = f"there is no {path}, which experiments.yaml names; make it, or correct data.path"
            elif cmu is None:
                found.missing[name] = (
                    f"there is no {path}; `ssmail prep-mocap --source DIR --out {path}` makes it of files of the CMU "
                    "database, and --download fetches those (or give --cmu-dir DIR)"
                )
            elif not cmu.exists():
                raise InputError(f"there is no {cmu}; --cmu-dir (or SSMAIL_CMU_DIR) names the folder or zip of 35.asf")
            else:
                found.made[name] = f"{path} is made from {cmu}"
    return found


def make_data(figures: Mapping[str, Sweep], data: DataFiles, cmu: Path | None) -> None:
    """Make the sets of recorded walking that can be made, as `ssmail prep-mocap` does by default.

    Raises InputError when a file of the database is missing or damaged.
    """
    paths = {path for name in data.made for path, _ in _absent(figures[name])}
    for path in sorted(paths):
        with redirect_stdout(sys.stderr):  # stdout is for the paths of the figures
            prep_mocap(source=cmu, out=Path(path))


def tell(data: DataFiles) -> None:
    """A line on stderr for each figure whose data is missing, and for each file that is going to be made."""
    for sentence in dict.fromkeys(data.made.values()):
        note(sentence)
    for name, sentence in data.missing.items():
        note(f"{name} is left out: {sentence}.")


def settled_runs(store: "Store", sweep: Sweep) -> "dict[Cell, str]":
    """The ids of those of the cells that have been computed, whatever has become of their data."""
    rows = {cell: store.find_cell(cell.spec.hash(), cell.seed) for cell in sweep}
    return {cell: row.id for cell, row in rows.items() if row is not None and row.state.settled}


def _absent(sweep: Sweep) -> set[tuple[str, str]]:
    """(path, environment) of the data files of the cells that do not exist."""
    needed = {(cell.spec.data.path, cell.spec.environment) for cell in sweep}
    return {(path, environment) for path, environment in needed if path is not None and not Path(path).exists()}
