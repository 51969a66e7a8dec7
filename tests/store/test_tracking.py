"""`ssmail runs export --to`: TensorBoard and MLflow show the metrics of every epoch."""

import math
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.store import RunRow, RunState, Store
from ssmail.store.tracking import to_mlflow, to_tensorboard

WRONG = "../../outside"


@pytest.fixture
def row(store: Store) -> RunRow:
    """A run of two epochs, with a metric whose name is a path."""
    writer = store.start_run(build_spec("ssail", "yjunction", "smoke"), 3, dataset_hash="d" * 64, device="cpu")
    writer.epoch(1, {"critic/loss": 0.5, "validation/mode_mse": 0.25, WRONG: 1.0})
    writer.epoch(2, {"critic/loss": math.inf, "validation/mode_mse": 0.125})
    writer.finish(RunState.FINISHED)
    (found,) = store.runs()
    return found


def test_tensorboard_reads_every_epoch(store: Store, row: RunRow, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="tensorboard, of the extra of that name, is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    to_tensorboard(store, [row], tmp_path / "logs")
    folder = tmp_path / "logs" / f"ssail-yjunction-seed3-{row.name}"
    events = EventAccumulator(str(folder)).Reload()
    assert sorted(events.Tags()["scalars"]) == ["critic/loss", "validation/mode_mse"]
    assert [(item.step, item.value) for item in events.Scalars("validation/mode_mse")] == [(1, 0.25), (2, 0.125)]
    assert events.Scalars("critic/loss")[1].value == math.inf
    assert b'"gamma": 0.95' in events.Tensors("spec/text_summary")[0].tensor_proto.string_val[0]
    with pytest.raises(InputError, match="exists already; choose another --out"):
        to_tensorboard(store, [row], tmp_path / "logs")


def test_mlflow_reads_every_epoch(store: Store, row: RunRow, tmp_path: Path) -> None:
    pytest.importorskip("mlflow", reason="mlflow, of the extra of that name, is not installed")
    to_mlflow(store, [row], tmp_path / "logs")
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=(tmp_path / "logs").as_uri())
    (experiment,) = [item for item in client.search_experiments() if item.name == "yjunction"]
    (run,) = client.search_runs([experiment.experiment_id])
    history = client.get_metric_history(run.info.run_id, "validation/mode_mse")
    assert [(item.step, item.value) for item in history] == [(1, 0.25), (2, 0.125)]
    assert (run.data.params["sac.gamma"], run.data.params["seed"], run.info.status) == ("0.95", "3", "FINISHED")
    assert WRONG not in run.data.metrics
    with pytest.raises(InputError, match=r"is in .* already"):
        to_mlflow(store, [row], tmp_path / "logs")


@pytest.mark.parametrize(
    ("package", "write"), [("torch.utils.tensorboard", to_tensorboard), ("mlflow.entities", to_mlflow)]
)
def test_a_missing_package_is_one_sentence(
    store: Store, row: RunRow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, write: object
) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(InputError, match=r"is not installed; run `pip install 'ssmail\[\w+\]'`"):
        write(store, [row], tmp_path / "logs")  # type: ignore[operator]
