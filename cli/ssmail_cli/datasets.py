"""`ssmail generate-yjunction` and `ssmail generate-letters`: expert sets as files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail_cli.output import write_json
from ssmail_cli.options import Json

if TYPE_CHECKING:
    from ssmail.config.sections import DataSpec

IN_FILE = "as in experiments.yaml"

Train = Annotated[int | None, typer.Option("--train", help="Training trajectories.", show_default=IN_FILE)]
Validation = Annotated[int | None, typer.Option("--validation", help="Validation trajectories.", show_default=IN_FILE)]
Test = Annotated[int | None, typer.Option("--test", help="Test trajectories.", show_default=IN_FILE)]
Steps = Annotated[int | None, typer.Option("--steps", help="Steps of a trajectory.", show_default=IN_FILE)]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of the generator.", show_default=IN_FILE)]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")]


def generate_yjunction(
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/yjunction.npz"),
    train: Train = None,
    validation: Validation = None,
    test: Test = None,
    agents: Annotated[int | None, typer.Option("--agents", help="Agents in the file.", show_default=IN_FILE)] = None,
    steps: Steps = None,
    lane_angle: Annotated[
        float | None,
        typer.Option("--lane-angle", help="Degrees between the street and each lane.", show_default=IN_FILE),
    ] = None,
    jitter: Annotated[
        float | None,
        typer.Option("--jitter", help="Scale of the random starts, gaps, speeds and offsets.", show_default=IN_FILE),
    ] = None,
    seed: Seed = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Generate the Y-Junction expert set.

    In each trajectory a file of agents takes one of two lanes. The .npz holds the three splits, their parameters and
    a hash. Train on it with --set data.path=FILE; without a file training generates the default set by itself.
    """
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
    _write(_data("yjunction", given), out, force, as_json)


def generate_letters(
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/letters.npz"),
    word: Annotated[
        str | None,
        typer.Option("--word", help="1 to 6 capital letters, an agent for each.", show_default=IN_FILE),
    ] = None,
    train: Train = None,
    validation: Validation = None,
    test: Test = None,
    steps: Steps = None,
    jitter: Annotated[
        float | None,
        typer.Option("--jitter", help="Scale of the hand's random starts, shapes and tempo.", show_default=IN_FILE),
    ] = None,
    seed: Seed = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Generate the expert set of the letters.

    Each agent draws a letter of the word. The .npz holds the three splits, the letters as drawn without jitter, their
    parameters and a hash. Train on it with --env letters --set data.path=FILE, or without a file on another word with
    --env letters --set data.letters.word=WORD.
    """
    given = {
        "word": word,
        "train": train,
        "validation": validation,
        "test": test,
        "steps": steps,
        "jitter": jitter,
        "seed": seed,
    }
    _write(_data("letters", given), out, force, as_json)


def _data(environment: str, given: Mapping[str, Any]) -> "DataSpec":
    """The data section of experiments.yaml with the options that were given. Raises InputError for a bad one."""
    from ssmail.config.experiments import build_spec
    from ssmail.config.spec import METHODS

    overrides = [f"data.{environment}.{key}={json.dumps(value)}" for key, value in given.items() if value is not None]
    return build_spec(METHODS[0], environment, "quick", overrides, source="the options").data


def _write(data: "DataSpec", out: Path, force: bool, as_json: bool) -> None:
    from ssmail.data import expert_file
    from ssmail.data.generators import generate

    experts = generate(data)
    expert_file.save(experts, out, force=force)
    if as_json:
        write_json({"path": out, "hash": experts.hash, "parameters": experts.parameters}, None)
        return
    sizes = f"{len(experts.train)}/{len(experts.validation)}/{len(experts.test)}"
    typer.echo(f"wrote {out}: {sizes} training/validation/test trajectories, hash {experts.hash[:16]}")
