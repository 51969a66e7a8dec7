"""The windows to forecast: the test split of an expert set, the end of each scene of a table, or an array."""

import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ssmail.config.foreign_files import ARCHIVE_ERRORS, open_regular
from ssmail.data.expert_sets import load
from ssmail.data.importing.cutting import LARGEST_SET, MOST_AGENTS, cut
from ssmail.data.importing.rows import quoted
from ssmail.data.importing.sources import TABLES, find_files, read_files
from ssmail.data.importing.tables import Columns
from ssmail.data.importing.tracks import LARGEST_FRAME, has_times, make_tracks
from ssmail.data.npz_file import LARGEST_FILE, Header, NpzFile
from ssmail.data.trajectories import ExpertSet, Floats, Integers
from ssmail.errors import InputError
from ssmail.inference.trained_run import TrainedRun

REMEDY = (
    "give a table (.csv or .parquet), an expert set, or an array (M, T, N, P) saved with numpy.save or "
    "numpy.savez(file, positions=array)"
)
_SET_ARRAYS = {"parameters.npy", "hash.npy"}


@dataclass(frozen=True)
class Origin:
    """Where windows come from, as far as the file says.

    scene: (W,) the name of the scene. start: (W,) the number of the first observed frame, in an expert set. In a table,
    frame, step: (W,) the last observed frame, and how far it is to the next one; agent: (W, N) the names.
    """

    scene: NDArray[np.str_]
    start: Integers | None = None
    frame: Floats | None = None
    step: Floats | None = None
    agent: NDArray[np.str_] | None = None


@dataclass(frozen=True)
class Windows:
    """Observed positions (W, T, N, P), one frame more than states, and the numbers (W,) of agents.

    Rows from a window's number of agents on are padding. steps: how many steps the expert set is made to predict; None
    for an array. origin: None for an array.
    """

    positions: Floats
    agents: Integers
    steps: int | None = None
    origin: Origin | None = None


@dataclass(frozen=True)
class TableOptions:
    """How to read a table: the names of its columns; and the seconds of a frame, if the frames are times."""

    columns: Columns = field(default_factory=Columns)
    dt: float | None = None


def read_windows(
    path: Path,
    run: TrainedRun,
    observed: int | None = None,
    table: TableOptions | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Windows:
    """Read what to forecast: the test split of an expert set, the end of each scene of a table, or an array.

    observed: how many frames of each window are observed. By default as many as in the test of the run, and of an array
    (M, T, N, P) all of them. The first velocity needs one frame before, which an expert set has and a table needs. Of a
    table, or a folder of tables, a window is the last frames of a scene, with the agents that are in all of them.
    report: is told of scenes without such agents.

    Raises InputError if the file is none of these, if it belongs to another environment, or if it has fewer frames.
    """
    if path.is_dir() or path.suffix.lower() in TABLES:
        return _of_tables(path, run, observed, table or TableOptions(), report)
    try:
        with open_regular(path) as file:
            packed, size = zipfile.is_zipfile(file), os.fstat(file.fileno()).st_size
            file.seek(0)
            if not packed:
                return _of_array(_single_array(file, size, path), path, observed)
            with zipfile.ZipFile(file) as archive:
                if set(archive.namelist()) >= _SET_ARRAYS:
                    return _of_set(load(path, run.spec.environment), run, observed)
                return _of_array(_packed_array(NpzFile(path, REMEDY, archive, size, packed=True)), path, observed)
    except FileNotFoundError:
        raise InputError(f"there is no file {path}; {REMEDY}") from None
    except ARCHIVE_ERRORS as error:
        reason = getattr(error, "strerror", None) or "it is damaged, or no file of numpy"
        raise InputError(f"{path} cannot be read: {reason}; {REMEDY}") from None


def _of_set(experts: ExpertSet, run: TrainedRun, observed: int | None) -> Windows:
    test, parameters = experts.test, experts.parameters
    wanted = observed or run.observed or parameters.get("observed")
    frames = test.positions.shape[1]
    count = wanted if isinstance(wanted, int) else frames
    if not 1 <= count <= frames:
        raise InputError(f"--observed is from 1 to {frames}, the frames of a test window, not {count}.")
    before = test.positions[:, :1] - test.velocities[:, :1]  # the first velocity is that from this frame
    positions = np.concatenate([before, test.positions[:, :count]], axis=1)
    every = np.full(len(test), positions.shape[2], dtype=np.int64)
    steps = run.predicted or parameters.get("predicted")
    origin = None
    if test.scene is not None and experts.scenes:
        origin = Origin(np.array(experts.scenes)[test.scene], start=test.frame)
    agents = every if test.agents is None else test.agents
    return Windows(positions, agents, steps if isinstance(steps, int) else None, origin)


def _of_tables(
    path: Path, run: TrainedRun, observed: int | None, table: TableOptions, report: Callable[[str], None]
) -> Windows:
    count = observed or run.observed
    if count is None:
        raise InputError("nothing tells how many frames of a scene are observed; give --observed.")
    frames = count + 1
    rows, _ = read_files(find_files([path]), table.columns, report)
    tracks, _ = make_tracks(rows, table.dt, fill_gaps=0)
    end = np.zeros(len(rows.scenes), dtype=np.int64)
    np.maximum.at(end, tracks.scene, tracks.begin + tracks.length)
    found = cut(tracks, end - frames, frames, stride=2 * LARGEST_FRAME)
    label = quoted(path, 80)
    if not len(found):
        raise InputError(
            f"no scene of {label} has an agent in each of its last {frames} frames, {count} to observe and one before "
            "for the velocity; lower --observed, or leave out the end of the scenes"
        )
    if missing := len(rows.scenes) - len(found):
        report(f"{missing:,} of {len(rows.scenes):,} scenes have no agent in all of their last {frames} frames")
    most = int(found.agents.max())
    if most > MOST_AGENTS or len(found) * frames * most * 24 > LARGEST_SET:
        raise InputError(f"{len(found):,} scenes of up to {most:,} agents are too many at once; give them in parts")
    agents = np.full((len(found), most), "", dtype=f"U{max(map(len, rows.agents))}")
    agents[found.window, found.slot] = np.array(rows.agents)[found.names]
    unit = table.dt if table.dt and has_times(rows) else 1.0
    step = tracks.step[found.scene].astype(np.float64) * unit
    last = tracks.first[found.scene] * unit + (end[found.scene] - 1) * step
    origin = Origin(np.array(rows.scenes)[found.scene], frame=last, step=step, agent=agents)
    return Windows(found.positions(most), found.agents, origin=origin)


def _of_array(positions: Floats, path: Path, observed: int | None) -> Windows:
    frames = positions.shape[1]
    count = frames if observed is None else observed
    if not 2 <= count <= frames:
        raise InputError(f"{path} has {frames} frames, and 2 to {frames} of them can be observed, not {count}.")
    every = np.full(len(positions), positions.shape[2], dtype=np.int64)
    return Windows(positions[:, :count], every)


def _packed_array(file: NpzFile) -> Floats:
    """Return the array `positions` of an .npz file, or the only one."""
    key = file.only_or("positions")
    if key is None:
        raise file.fault(f"{file.path} holds {len(file.headers)} arrays, and none is called positions")
    if file.header(key).dtype.kind == "U":
        raise _no_numbers(file.path)
    return _checked(file.values(key), file.path)


def _single_array(file: IO[bytes], size: int, path: Path) -> Floats:
    """Return the array of a .npy file of `size` bytes."""
    header = Header.read(file)
    if header is None or header.dtype.kind == "U" or header.size != size or size > LARGEST_FILE:
        raise _no_numbers(path)
    return _checked(header.values(file), path)


def _no_numbers(path: Path) -> InputError:
    kinds = "of floats or signed integers"
    return InputError(f"{path} cannot be read: it is no array of numbers as large as it says, {kinds}; {REMEDY}")


def _checked(values: Any, path: Path) -> Floats:
    """Return an array as positions. Raises InputError unless it has four axes and is finite."""
    if values.ndim != 4 or not values.size or values.shape[3] > 3:
        shown = " x ".join(map(str, values.shape[:6]))
        raise InputError(f"the array in {path} is {shown} instead of (M, T, N, P) with P of 1 to 3; reshape it")
    array: Floats = values.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"the array in {path} holds NaN or infinite values; leave these windows out")
    return array
