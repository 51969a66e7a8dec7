"""Trajectories in the format of the library `imitation`: folders that `imitation.data.serialize` loads and saves.

A trajectory is one window with all its agents, as a single learner would see them. `obs` (T, N * 2P) holds
[position, velocity] of one agent after the other; `acts` (T - 1, N * P) their next velocities in the same order;
`infos` are empty; `terminal` is false, because windows end by truncation. There are no rewards. All is in raw units.

Such a folder may come from anyone. `imitation` itself decodes the `infos` with jsonpickle, which can run code, and
opens the files that the folder names, wherever they are. Here the `infos` are not read, and of files only those within
the folder are.
"""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ssmail.config.foreign_files import open_regular, read_whole
from ssmail.data.trajectories import Floats, Trajectories
from ssmail.errors import InputError, missing_package

LARGEST_FILE = 2**31  # bytes
DATA = re.compile(r"data-\d{5}-of-\d{5}\.arrow")


def write_imitation(trajectories: Trajectories, folder: Path) -> None:
    """Write the windows of a split into a new folder, whole or not at all.

    Where windows have different numbers of agents, so do the observations; most learners want them equal. Raises
    InputError if there is such a file or folder, if it cannot be written, and if the package `datasets` is missing.
    """
    try:
        from datasets import Dataset
    except ModuleNotFoundError as error:
        raise missing_package(error, "adapters") from None
    if folder.exists() or folder.is_symlink():
        raise InputError(f"{folder} exists already; choose another folder or delete it")
    positions, velocities, agents = trajectories.positions, trajectories.velocities, trajectories.agents
    windows, steps, most, _ = positions.shape
    counts = [most] * windows if agents is None else agents.tolist()
    states = np.concatenate([positions, velocities], axis=-1)  # (B, T, N, 2P)
    columns = {
        "obs": [state[:, :count].reshape(steps, -1) for state, count in zip(states, counts, strict=True)],
        "acts": [moves[1:, :count].reshape(steps - 1, -1) for moves, count in zip(velocities, counts, strict=True)],
        "infos": [["{}"] * (steps - 1)] * windows,
        "terminal": [False] * windows,
    }
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as partial:
            written = Path(partial, "trajectories")
            Dataset.from_dict(columns).save_to_disk(written)
            written.rename(folder)
    except OSError as error:
        raise InputError(f"cannot write {folder}: {error.strerror or error}; choose a writable folder") from error


def read_imitation(folder: Path, *, axes: int = 2, positions: Callable[[Floats], Any] | None = None) -> list[Floats]:
    """Return the positions (F, N, P) of each trajectory in a folder, in raw units.

    positions: turns the observations (T, D) of a trajectory into positions (T, N, P). Without it the observations must
    be laid out as `write_imitation` does, with P = `axes`; then the first velocities give one frame before the first
    observation, F = T + 1, and the windows that were written come back.

    Raises InputError that names the folder, and the number of the trajectory, if one cannot be read, and if the package
    `pyarrow` is missing.
    """
    return [
        _frames(observations, axes, positions, f"trajectory {number} in {folder}")
        for number, observations in enumerate(_observations(folder))
    ]


def _frames(observations: Floats, axes: int, positions: Callable[[Floats], Any] | None, label: str) -> Floats:
    length, size = observations.shape
    if positions is None:
        if not 1 <= axes <= 3 or not size or size % (2 * axes):
            raise InputError(
                f"{label} has {size} numbers in an observation, not positions and velocities on {axes} axes; give "
                "`axes`, or `positions`, which picks them out"
            )
        places, velocities = np.split(observations.reshape(length, -1, 2 * axes), 2, axis=-1)
        with np.errstate(invalid="ignore", over="ignore"):
            frames = np.concatenate([places[:1] - velocities[:1], places])
    else:
        frames = np.asarray(positions(observations), dtype=np.float64)
        if frames.ndim != 3 or len(frames) != length or not 1 <= frames.shape[2] <= 3 or not frames.shape[1]:
            raise InputError(f"`positions` makes {frames.shape} of {label}; return ({length}, agents, 1 to 3 axes)")
    if not np.isfinite(frames).all():
        raise InputError(f"{label} holds NaN or infinite values; leave it out")
    return frames


def _observations(folder: Path) -> list[Floats]:
    """Return the observations (T, D) of all trajectories in a folder."""
    try:
        import pyarrow as pa
    except ModuleNotFoundError as error:
        raise missing_package(error, "adapters") from None
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder as imitation.data.serialize.save writes it; load an older .npz or .pkl file "
            "with imitation and save it again"
        )
    files = sorted(path for path in folder.iterdir() if DATA.fullmatch(path.name))
    if not files:
        raise InputError(f"{folder} holds no data-*.arrow; write it with imitation.data.serialize.save")
    found = []
    for path in files:
        try:
            with open_regular(path, follow=False) as file:
                contents = read_whole(file, LARGEST_FILE)
            if contents is None:
                raise InputError(f"{path} has more than 2 GiB; save the trajectories in several folders")
            table = pa.ipc.open_stream(contents).read_all()
            table.validate(full=True)
            for row in table.column("obs"):
                found.append(_matrix(row.values))
        except (pa.ArrowException, OSError, MemoryError, ValueError, LookupError, AttributeError, TypeError) as error:
            raise InputError(
                f"{path} holds no trajectories with observations (T, D) of numbers; write it again with "
                "imitation.data.serialize.save"
            ) from error
    return found


def _matrix(steps: Any) -> Floats:
    """Return an Arrow array of lists as a matrix. Raises ValueError or AttributeError if it is none."""
    sizes = set(steps.value_lengths().to_pylist())
    if len(sizes) != 1 or steps.null_count:
        raise ValueError("the lists differ in length")
    values: Floats = steps.flatten().to_numpy(zero_copy_only=False).astype(np.float64).reshape(len(steps), -1)
    return values
