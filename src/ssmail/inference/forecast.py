"""Forecasts of many windows, as a table with a row for each position, or as arrays."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmail.data.atomic_file import atomic_write
from ssmail.data.expert_sets import check_target
from ssmail.data.trajectories import Floats, Integers
from ssmail.errors import InputError, missing_package, unknown_name
from ssmail.inference.trained_run import TrainedRun
from ssmail.inference.windows import Origin, Windows

if TYPE_CHECKING:
    import pandas as pd

FORMATS = (".csv", ".parquet", ".npz")
AXES = ("x", "y", "z")
ROWS = 10**6  # of a piece of the table that is written at once
MOST_NUMBERS = 5 * 10**8  # in a forecast; 4 GB


@dataclass(frozen=True)
class Forecast:
    """Sampled futures of W windows.

    positions: (S, W, T', N, P), raw units, NaN for agents that a window does not have. agents: (W,) how many it has.
    origin: the scenes, frames and agents in the file, as far as it has them.
    """

    positions: Floats
    agents: Integers
    origin: Origin | None = None

    @property
    def frames(self) -> Floats | None:
        """The numbers (W, T') of the predicted frames, or their times; None unless the windows are of a table."""
        if self.origin is None or self.origin.frame is None or self.origin.step is None:
            return None
        steps = np.arange(1, self.positions.shape[2] + 1)
        frames: Floats = np.round(self.origin.frame[:, None] + steps * self.origin.step[:, None], 9)
        return frames.astype(np.int64) if (frames % 1 == 0).all() else frames

    def pieces(self) -> "Iterator[pd.DataFrame]":
        """Yield the table in pieces of some windows: window, sample, step, agent, and x, y, z as far as there are axes.

        Windows, samples and agents count from 0, and steps from 1, the first one after the observed frames. Windows of
        an expert set also have their scene and its first observed frame, `start`; those of a table the scene, the
        predicted frame, and the agent's name instead of its number.
        """
        import pandas as pd

        samples, windows, steps, agents, axes = self.positions.shape
        together = max(ROWS // (samples * steps * agents), 1)
        origin, frames = self.origin, self.frames
        for first in range(0, windows, together):
            part = self.positions[:, first : first + together].swapaxes(0, 1)  # (W, S, T', N, P)
            w, s, t, n = (index.ravel() for index in np.indices(part.shape[:-1]))
            w = w + first
            present = n < self.agents[w]
            columns: dict[str, Any] = {"window": w}
            if origin is not None:
                columns["scene"] = origin.scene[w]
            if origin is not None and origin.start is not None:
                columns["start"] = origin.start[w]
            columns |= {"sample": s, "step": t + 1}
            if frames is not None:
                columns["frame"] = frames[w, t]
            columns["agent"] = n if origin is None or origin.agent is None else origin.agent[w, n]
            columns |= dict(zip(AXES, part.reshape(-1, axes).T, strict=False))
            yield pd.DataFrame({name: values[present] for name, values in columns.items()})


def forecast(run: TrainedRun, windows: Windows, steps: int | None, samples: int, seed: int) -> Forecast:
    """Sample the futures of all windows, those with the same number of agents together (`TrainedRun.rollout`).

    steps: by default as many as in the test of the run, as far as it can predict. Raises InputError if nothing tells
    how many, or if the forecast would be too large.
    """
    w, frames, n, axes = windows.positions.shape
    count, most = steps or windows.steps or run.predicted, run.most_steps(frames)
    if count is None:
        raise InputError("nothing tells how many steps to predict; give --steps.")
    if steps is None and most is not None:
        count = max(min(count, most), 1)
    if samples * w * count * n * axes > MOST_NUMBERS:
        raise InputError(
            f"{samples} samples of {w} windows, {count} steps and {n} agents do not fit into memory; lower --samples "
            "or --steps, or give fewer windows."
        )
    futures = np.full((samples, w, count, n, axes), np.nan)
    for number in np.unique(windows.agents):
        chosen = np.flatnonzero(windows.agents == number)
        futures[:, chosen, :, :number] = run.rollout(windows.positions[chosen, :, :number], count, samples, seed)
    return Forecast(futures, windows.agents, windows.origin)


def check_output(path: Path, *, force: bool) -> None:
    """Raise InputError if a forecast cannot be written to `path`: its ending, the packages, what is there already."""
    if path.suffix.lower() not in FORMATS:
        raise unknown_name("ending of --out", path.suffix or "(none)", FORMATS)
    if path.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError as error:
            raise missing_package(error, "parquet") from None
    check_target(path, force=force)


def write(found: Forecast, path: Path, *, force: bool = False) -> int:
    """Write a forecast to a .csv, .parquet or .npz file, whole or not at all; return the number of its rows.

    An .npz file holds the arrays `positions` and `agents`, and `scene`, `start`, `frame` and `agent` as far as the data
    have them. Raises InputError as `check_output` does, and if the file cannot be written.
    """
    check_output(path, force=force)
    writers = {".csv": _write_csv, ".parquet": _write_parquet, ".npz": _write_arrays}
    try:
        with atomic_write(path, overwrite=force) as partial:
            writers[path.suffix.lower()](found, partial)
    except FileExistsError:
        check_target(path, force=False)
        raise
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; choose a writable --out") from error
    samples, _, steps, *_ = found.positions.shape
    rows: int = sum(found.agents.tolist()) * samples * steps
    return rows


def _write_csv(found: Forecast, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        for number, piece in enumerate(found.pieces()):
            piece.to_csv(file, index=False, header=not number, lineterminator="\n")


def _write_parquet(found: Forecast, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer = None
    try:
        for piece in found.pieces():
            table = pa.Table.from_pandas(piece, preserve_index=False)
            writer = writer or pq.ParquetWriter(path, table.schema)
            writer.write_table(table)
    finally:
        if writer is not None:
            writer.close()


def _write_arrays(found: Forecast, path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, positions=found.positions, agents=found.agents, **_origin_arrays(found))


def _origin_arrays(found: Forecast) -> dict[str, Any]:
    """Return which scenes, frames (W, T') and agents (W, N) the positions are of, as far as the data have them."""
    if found.origin is None:
        return {}
    arrays = {"scene": found.origin.scene, "start": found.origin.start, "frame": found.frames}
    return {name: array for name, array in (arrays | {"agent": found.origin.agent}).items() if array is not None}
