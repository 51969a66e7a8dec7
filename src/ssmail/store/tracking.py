"""Stored runs for other people's tools: the metrics of every epoch and the spec, for TensorBoard or MLflow."""

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TypeVar

from ssmail.config.names import flatten
from ssmail.errors import InputError, missing_package, shortened
from ssmail.store.queries import RunRow
from ssmail.store.run_store import Store
from ssmail.store.schema import RunState

T = TypeVar("T")
_NAME = re.compile(r"[\w-][\w.-]*(/[\w-][\w.-]*)*", re.ASCII)
"""Names of metrics that both tools take. MLflow makes paths of them, so a database may not choose others."""
_TOGETHER = 1000, 100  # metrics and parameters that MLflow takes at once
_LONGEST = 500  # characters of a parameter
_ENDS = {RunState.FINISHED: "FINISHED", RunState.RUNNING: "RUNNING", RunState.INTERRUPTED: "KILLED"}


def to_tensorboard(store: Store, runs: Sequence[RunRow], folder: Path) -> None:
    """Write an event file for each run into a folder of its own below `folder`: scalars, and the spec as text.

    Raises InputError if such a folder exists, if it cannot be written, or without the package.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise missing_package(error, "tensorboard") from None
    targets = {row.id: folder / _label(row) for row in runs}
    for target in targets.values():
        if target.exists():
            raise InputError(f"{target} exists already; choose another --out, or remove it")
    for row in runs:
        try:
            with SummaryWriter(str(targets[row.id])) as writer:
                began = row.started.timestamp()
                spec = json.dumps(row.spec, indent=2)
                writer.add_text("spec", f"```json\n{spec}\n```", walltime=began)
                for name, step, value in _metrics(store, row):
                    writer.add_scalar(name, value, step, walltime=began + step)
        except OSError as error:
            raise _unwritable(folder, error) from error


def to_mlflow(store: Store, runs: Sequence[RunRow], folder: Path) -> None:
    """Write a run of MLflow for each run into the file store `folder`, one experiment for each environment.

    Metrics keep their names, and the spec becomes parameters. Raises InputError if a run is there already, if the
    folder cannot be written, or without the package.
    """
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
    try:
        from mlflow.entities import Metric, Param
        from mlflow.tracking import MlflowClient
    except ImportError as error:
        raise missing_package(error, "mlflow") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        client = MlflowClient(tracking_uri=folder.resolve().as_uri())
        for row in runs:
            experiment = client.get_experiment_by_name(_plain(row.environment))
            place = experiment.experiment_id if experiment else client.create_experiment(_plain(row.environment))
            if client.search_runs([place], f"tags.`ssmail.run_id` = '{row.id}'"):
                raise InputError(f"run {row.name} is in {folder} already; choose another --out")
            began = int(1000 * row.started.timestamp())
            tags = {"mlflow.runName": _label(row), "ssmail.run_id": row.id, "ssmail.data": row.dataset_hash or ""}
            made = client.create_run(place, start_time=began, tags=tags).info.run_id
            values = (Metric(name, value, began + 1000 * step, step) for name, step, value in _metrics(store, row))
            settings = {"seed": row.seed, "profile": row.profile, **flatten(row.spec)}
            for metrics in _batches(values, _TOGETHER[0]):
                client.log_batch(made, metrics=metrics)
            for params in _batches(_texts(settings), _TOGETHER[1]):
                client.log_batch(made, params=[Param(*param) for param in params])
            ended = int(1000 * (row.finished or row.heartbeat).timestamp())
            client.set_terminated(made, _ENDS.get(row.state, "FAILED"), ended)
    except OSError as error:
        raise _unwritable(folder, error) from error


TOOLS: Mapping[str, Callable[[Store, Sequence[RunRow], Path], None]] = {
    "tensorboard": to_tensorboard,
    "mlflow": to_mlflow,
}


def _metrics(store: Store, row: RunRow) -> Iterator[tuple[str, int, float]]:
    """Yield name, epoch and value of every metric with an ordinary name."""
    frame = store.metrics([row.id])
    for name, step, value in zip(frame["name"], frame["step"], frame["value"], strict=True):
        if _NAME.fullmatch(name) and len(name) <= 200:
            yield name, int(step), float(value)


def _texts(settings: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    for key, value in settings.items():
        if _NAME.fullmatch(key) and len(key) <= 200:
            yield key, shortened(str(value), _LONGEST)


def _batches(items: Iterator[T], size: int) -> Iterator[list[T]]:
    while batch := list(islice(items, size)):
        yield batch


def _label(row: RunRow) -> str:
    """Return the name of a run: "ssail-yjunction-seed0-3f2a81c0"."""
    return f"{_plain(row.method)}-{_plain(row.environment)}-seed{row.seed}-{row.name}"


def _plain(name: str) -> str:
    return re.sub(r"[^\w-]", "_", name, flags=re.ASCII)[:40] or "_"


def _unwritable(folder: Path, error: OSError) -> InputError:
    return InputError(f"cannot write into {folder}: {error.strerror or error}; choose another --out")
