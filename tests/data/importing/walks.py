"""Positions to import, as arrays and as tables."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ssmail.data.importing.dataset import ImportOptions, import_set
from ssmail.data.importing.summary import Summary
from ssmail.data.importing.tables import Columns
from ssmail.data.trajectories import ExpertSet

SHORT: dict[str, Any] = {"window": 4, "observed": 2}


def walks(scenes: int = 4, frames: int = 9, agents: int = 2, axes: int = 2) -> np.ndarray:
    """Positions (scenes, frames, agents, axes) to four decimals."""
    return np.random.default_rng(0).normal(size=(scenes, frames, agents, axes)).cumsum(axis=1).round(4)


def table_of(positions: np.ndarray) -> pd.DataFrame:
    scene, frame, agent = (index.ravel() for index in np.indices(positions.shape[:3]))
    columns = dict(zip("xyz", positions.reshape(-1, positions.shape[-1]).T, strict=False))
    return pd.DataFrame({"scene": scene, "frame": frame, "agent": agent} | columns)


def imported(*sources: Path, columns: Columns | None = None, **options: Any) -> tuple[ExpertSet, Summary]:
    return import_set(sources, ImportOptions(columns=columns or Columns(), **SHORT | options))
