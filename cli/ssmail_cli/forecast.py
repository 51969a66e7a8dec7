"""`ssmail forecast` and `ssmail export-model`: use the trained model of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ssmail_cli import options
from ssmail_cli.artifacts import ArtifactsGiven
from ssmail_cli.import_data import (
    AgentColumn,
    FrameColumn,
    SceneColumn,
    StepSeconds,
    XColumn,
    YColumn,
    ZColumn,
    seconds,
)
from ssmail_cli.output import note, say, write_json

if TYPE_CHECKING:
    from ssmail.inference.trained_run import Model

ModelOption = Annotated[
    str, typer.Option("--model", help="best: with the smallest validation error; last: of the last epoch.")
]
DataOption = Annotated[
    Path | None,
    typer.Option("--data", help="The expert set of the run, which only runs of earlier versions need."),
]


def forecast(
    run: options.RunId,
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA",
            help="A table as for import-data (the last frames of each scene), an expert set (its test split), or an "
            "array (M, T, N, P) in .npy or .npz.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The .csv, .parquet or .npz file to write.")] = Path("futures.csv"),
    samples: Annotated[int, typer.Option("--samples", min=1, max=10_000, help="Futures of each window.")] = 20,
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, max=100_000, help="Steps to predict.", show_default="as in the test of the run"),
    ] = None,
    observed: Annotated[
        int | None,
        typer.Option(
            "--observed",
            min=1,
            help="Frames of each window that the model reads.",
            show_default="as in the test of the run; of an array all",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Of the samples.")] = 0,
    scene: SceneColumn = None,
    frame: FrameColumn = None,
    agent: AgentColumn = None,
    x: XColumn = None,
    y: YColumn = None,
    z: ZColumn = None,
    dt: StepSeconds = None,
    model: ModelOption = "best",
    expert_set: DataOption = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")] = False,
    as_json: options.Json = False,
    artifacts: ArtifactsGiven = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Sample the futures of observed agents with the trained model of a run.

    Writes a row for each window, sample, step and agent, with its position x, y and z in the units of the data; .npz
    has the positions (samples, windows, steps, agents, axes) instead. A table is forecast beyond the end of each of its
    scenes, for the agents that are present in the last frames, and the rows have its scenes, frames and agents. The
    same seed yields the same numbers.
    """
    from ssmail.data.importing.tables import Columns
    from ssmail.inference import forecast as forecasts
    from ssmail.inference.trained_run import load_from
    from ssmail.inference.windows import TableOptions, read_windows

    forecasts.check_output(out, force=force)
    trained = load_from(options.open_store(db, artifacts=artifacts), run, model=cast("Model", model), data=expert_set)
    table = TableOptions(Columns(scene, frame, agent, x, y, z), seconds(dt))
    windows = read_windows(data, trained, observed, table, note)
    found = forecasts.forecast(trained, windows, steps, samples, seed)
    rows = forecasts.write(found, out, force=force)
    _, w, t, *_ = found.positions.shape
    if as_json:
        described = {"run": trained.id, "model": trained.model, "epoch": trained.epoch, "seed": seed}
        write_json({"path": out, **described, "windows": w, "samples": samples, "steps": t, "rows": rows}, None)
        return
    which = f"run {trained.id[:8]} ({trained.spec.method}, {trained.model} model, of epoch {trained.epoch})"
    say(f"wrote {out}: {w} windows, {samples} samples of {t} steps each, by {which}")
    if trained.predictor.features is None and samples > 1:
        note(f"{trained.spec.method} has no randomness: the samples of a window are all alike")


def export_model(
    run: options.RunId,
    out: Annotated[Path, typer.Option("--out", help="The folder to write.")],
    agents: Annotated[
        int | None,
        typer.Option(
            "--agents",
            min=1,
            max=1000,
            help="Agents of a group; of your own data, it has to be given unless the model tells its agents apart.",
            show_default="as in the data",
        ),
    ] = None,
    batch: Annotated[int, typer.Option("--batch", min=1, max=1000, help="Groups that a program steps at once.")] = 1,
    onnx: Annotated[bool, typer.Option("--onnx/--no-onnx", help="Write the programs as ONNX too.")] = True,
    model: ModelOption = "best",
    expert_set: DataOption = None,
    force: Annotated[bool, typer.Option("--force", help="Write into a folder that is not empty.")] = False,
    as_json: options.Json = False,
    artifacts: ArtifactsGiven = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Export the trained model of a run for use without ssmail.

    Writes the weights (safetensors), the spec, a model card, and one step of the model as a program for torch.export
    and ONNX: positions and velocities in, the next ones out, in the units of the data, with the noise as an input.
    """
    from ssmail.inference.model_export import export
    from ssmail.inference.trained_run import load_from

    trained = load_from(options.open_store(db, artifacts=artifacts), run, model=cast("Model", model), data=expert_set)
    files = export(trained, out, agents=agents, batch=batch, onnx=onnx, force=force)
    if as_json:
        write_json({"path": out, "run": trained.id, "model": trained.model, "files": files}, None)
    else:
        say(f"wrote {out}: {', '.join(files)}")
