"""`ssmail generate-yjunction`: the expert set as a file."""

from pathlib import Path
from typing import Annotated

import typer

from ssmail_cli.display import write_json
from ssmail_cli.options import Json

IN_FILE = "as in experiments.yaml"


def generate_yjunction(
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/yjunction.npz"),
    train: Annotated[int | None, typer.Option("--train", help="Training trajectories.", show_default=IN_FILE)] = None,
    validation: Annotated[
        int | None, typer.Option("--validation", help="Validation trajectories.", show_default=IN_FILE)
    ] = None,
    test: Annotated[int | None, typer.Option("--test", help="Test trajectories.", show_default=IN_FILE)] = None,
    agents: Annotated[int | None, typer.Option("--agents", help="Agents in the file.", show_default=IN_FILE)] = None,
    steps: Annotated[int | None, typer.Option("--steps", help="Steps of a trajectory.", show_default=IN_FILE)] = None,
    lane_angle: Annotated[
        float | None,
        typer.Option("--lane-angle", help="Degrees between the street and each lane.", show_default=IN_FILE),
    ] = None,
    jitter: Annotated[
        float | None,
        typer.Option("--jitter", help="Scale of the random starts, gaps, speeds and offsets.", show_default=IN_FILE),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the generator.", show_default=IN_FILE)] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")] = False,
    as_json: Json = False,
) -> None:
    """Generate the Y-Junction expert set.

    In each trajectory a file of agents takes one of two lanes. The .npz holds the three splits, their parameters and
    a hash. Train on it with --set data.path=FILE; without a file training generates the default set by itself.
    """
    from ssmail.data import expert_file, yjunction
    from ssmail.experiments import build_spec
    from ssmail.spec import METHODS, used

    given = {
        "train": train,
        "validation": validation,
        "test": test,
        "agents": agents,
        "steps": steps,
        "lane_angle": lane_angle,
        "jitter": jitter,
        "seed": seed,
    }
    overrides = [f"data.yjunction.{key}={value}" for key, value in given.items() if value is not None]
    spec = build_spec(METHODS[0], "yjunction", "quick", overrides, source="the options")
    experts = yjunction.generate(used(spec.data.yjunction))
    expert_file.save(experts, out, force=force)
    if as_json:
        write_json({"path": out, "hash": experts.hash, "parameters": experts.parameters}, None)
        return
    sizes = f"{len(experts.train)}/{len(experts.validation)}/{len(experts.test)}"
    typer.echo(f"wrote {out}: {sizes} training/validation/test trajectories, hash {experts.hash[:16]}")
