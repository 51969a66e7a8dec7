"""Read positions (M, T, N, P) from .npy and .npz files, never unpickled."""

import os
import zipfile
from typing import IO, Any

import numpy as np

from ssmail.config.foreign_files import ARCHIVE_ERRORS, open_regular
from ssmail.data.importing.rows import LARGEST_POSITION, MOST_ROWS, RowCollector, SourceFile, quoted
from ssmail.data.npz_file import LARGEST_FILE, Header, NpzFile
from ssmail.data.trajectories import Floats
from ssmail.errors import InputError

KEY = "positions"
REMEDY = "save it with numpy.savez(file, positions=array), as numbers of float64"


def read_array(file: SourceFile, collector: RowCollector) -> None:
    """Read M sequences, each of which becomes a scene of T frames in which the same N agents are present.

    An .npz file has a single array, or one called "positions". Raises InputError that names the file, the array and the
    index if it is one of them.
    """
    try:
        with open_regular(file.path) as opened:
            size = os.fstat(opened.fileno()).st_size
            if file.path.suffix.lower() == ".npy":
                add_array(_single(opened, size, file.label), "the array", file, collector)
            else:
                with zipfile.ZipFile(opened) as archive:
                    found = NpzFile(file.path, REMEDY, archive, size, packed=True)
                    key = _key(found, file.label)
                    add_array(found.values(key), f"the array {key!r:.40}", file, collector)
    except ARCHIVE_ERRORS as error:
        if isinstance(error, FileNotFoundError | PermissionError):
            raise
        raise InputError(f"{file.label} is truncated or no file of numpy; {REMEDY}") from None


def _single(opened: IO[bytes], size: int, label: str) -> Any:
    header = Header.read(opened)
    if header is None or header.dtype.kind == "U":
        raise InputError(f"{label} is no array of numbers; {REMEDY}")
    if header.size != size or size > LARGEST_FILE:
        raise InputError(f"{label} is not as large as its shape says, or larger than 2 GiB; {REMEDY}")
    return header.values(opened)


def _key(file: NpzFile, label: str) -> str:
    """Return the name of the array with the positions."""
    if {"parameters", "hash", "train/positions"} <= file.headers.keys():
        raise InputError(f"{label} is an expert set already; train on it with --set data.path")
    key = file.only_or(KEY)
    if key is None:
        raise InputError(f"{label} holds {len(file.headers)} arrays, none of them called {KEY}; {REMEDY}")
    if file.header(key).dtype.kind == "U":
        raise InputError(f"the array {key!r:.40} of {label} holds text; {REMEDY}")
    return key


def add_array(array: Any, what: str, file: SourceFile, collector: RowCollector) -> None:
    """Add the rows of an array (M, T, N, P), agent by agent, with all that `file` has. what: the array in messages.

    Raises InputError for another shape, and for positions that are not finite or too large.
    """
    if array.ndim != 4 or not 1 <= array.shape[3] <= 3 or not array.size:
        shape = "x".join(map(str, array.shape[:6]))
        raise InputError(
            f"{what} of {file.label} has the shape {shape} instead of (scenes, frames, agents, axes) with 1 to 3 axes; "
            "reshape it, a single scene with array[None]"
        )
    scenes, frames, agents, axes = array.shape
    if scenes * frames * agents > MOST_ROWS:
        raise InputError(f"{file.label} has more than {MOST_ROWS:,} positions; import it in several sets")
    array = array.astype(np.float64)
    wrong = ~(np.abs(array) <= LARGEST_POSITION)
    if wrong.any():
        index = np.unravel_index(int(wrong.argmax()), array.shape)
        value = quoted(array[index])
        raise InputError(
            f"{what} of {file.label} holds {value} at [{', '.join(map(str, index))}]; give every agent a position in "
            "every frame, or import a table, which can leave rows out"
        )
    names = [file.scene] if scenes == 1 else [f"{file.scene}/{number}" for number in range(scenes)]
    scene = np.repeat(collector.scenes.number(names, file.label), frames * agents)
    agent = np.tile(np.repeat(collector.agents.number(range(agents), file.label), frames), scenes)
    positions: Floats = array.transpose(0, 2, 1, 3).reshape(-1, axes)
    collector.add(file, scene, np.tile(np.arange(frames, dtype=np.float64), scenes * agents), agent, positions)
    collector.end(file, lambda row: f"scene {row // (frames * agents)}, frame {row % frames}")
