"""The windows to forecast: the test split of an expert set, or an array of positions from anyone."""

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ssmail.config.foreign_files import ARCHIVE_ERRORS, open_regular
from ssmail.data.expert_sets import load
from ssmail.data.npz_file import LARGEST_FILE, Header, NpzFile
from ssmail.data.trajectories import ExpertSet, Floats, Integers
from ssmail.errors import InputError
from ssmail.inference.trained_run import TrainedRun

REMEDY = "give an expert set, or an array (M, T, N, P) saved with numpy.save or numpy.savez(file, positions=array)"
_SET_ARRAYS = {"parameters.npy", "hash.npy"}


@dataclass(frozen=True)
class Windows:
    """Observed positions (W, T, N, P), one frame more than states, and the numbers (W,) of agents.

    Rows from a window's number of agents on are padding. steps: how many steps the expert set is made to predict; None
    for an array.
    """

    positions: Floats
    agents: Integers
    steps: int | None = None


def read_windows(path: Path, run: TrainedRun, observed: int | None = None) -> Windows:
    """Read what to forecast from an expert set, of which it is the test split, or from an array (M, T, N, P).

    observed: how many frames of each window are observed. By default as many as in the test of the run, and of an array
    all of them. An expert set also holds the velocities of its first frames, so these count as states.

    Raises InputError if the file is none of the two, if it belongs to another environment, or if it has fewer frames.
    """
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
    return Windows(positions, every if test.agents is None else test.agents, steps if isinstance(steps, int) else None)


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
