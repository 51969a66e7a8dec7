"""`ssmail generate-yjunction`, `generate-letters` and `prep-mocap`: expert sets as files."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError
from ssmail_cli.options import Json
from ssmail_cli.output import note, say, write_json

if TYPE_CHECKING:
    from ssmail.data.trajectories import ExpertSet

IN_FILE = "as in experiments.yaml"
DEFAULT_CACHE = "data/cmu"

Train = Annotated[int | None, typer.Option("--train", help="Training trajectories.", show_default=IN_FILE)]
Validation = Annotated[int | None, typer.Option("--validation", help="Validation trajectories.", show_default=IN_FILE)]
Test = Annotated[int | None, typer.Option("--test", help="Test trajectories.", show_default=IN_FILE)]
Steps = Annotated[int | None, typer.Option("--steps", help="Steps of a trajectory.", show_default=IN_FILE)]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of the generator.", show_default=f"{IN_FILE}, else 0")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")]


def generate_yjunction(
    ctx: typer.Context,
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

    In each trajectory, agents in single file take one of two lanes. The .npz holds the three splits, their parameters
    and a hash. Train on it with --set data.path=FILE; without a file, training generates the default set itself.
    """
    _generate("yjunction", ctx, out, force, as_json)


def generate_letters(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/letters.npz"),
    word: Annotated[
        str | None,
        typer.Option("--word", help="1 to 6 capital letters, one agent each.", show_default=IN_FILE),
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
    """Generate the letters expert set.

    Each agent draws a letter of the word. The .npz holds the three splits, the letters drawn without jitter, their
    parameters and a hash. Train on it with --env letters --set data.path=FILE, or without a file on another word with
    --env letters --set data.letters.word=WORD.
    """
    _generate("letters", ctx, out, force, as_json)


def prep_mocap(
    source: Annotated[
        Path | None,
        typer.Option("--source", help="Folder or zip file that contains 35.asf and 35_01.amc ... at any depth."),
    ] = None,
    download: Annotated[
        bool, typer.Option("--download", help="Fetch the files from the CMU site (slow, plain HTTP) into --cache.")
    ] = False,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="With --download: folder to keep the files in.", show_default=DEFAULT_CACHE),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/mocap.npz"),
    subject: Annotated[int, typer.Option("--subject", min=1, max=999, help="Number of the subject.")] = 35,
    train: Annotated[str, typer.Option("--train", help="Trials to train on: 01-12 or 1-3,7.")] = "01-12",
    validation: Annotated[str, typer.Option("--validation", "--val", help="Trials to validate on.")] = "13-16",
    test: Annotated[str, typer.Option("--test", help="Trials to test on.")] = "28-34",
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Continue without trials that do not exist.")
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Prepare the Noisy Mocap expert set from files of the CMU motion capture database.

    Cuts the trials into windows of 50 frames, and of 100 for testing. The .npz holds positions and velocities of all
    joints in the units of the files, the skeleton, and the origin of each window. Train on it with --env mocap.
    """
    from ssmail.data import expert_sets
    from ssmail.data.mocap.dataset import MocapParameters, parse_trials, prepare

    wanted = MocapParameters(
        subject=subject,
        train=parse_trials(train, "--train"),
        validation=parse_trials(validation, "--validation"),
        test=parse_trials(test, "--test"),
    )
    if cache is not None and not download:
        raise InputError("--cache belongs to --download; leave --cache out, or let --download fetch the files into it")
    if (source is None) == (not download):
        raise InputError("give either --source with a folder or zip file of the CMU files, or --download")
    expert_sets.check_target(out, force=force)
    if source is None:
        from ssmail.data.mocap.download import fetch

        trials = (*wanted.train, *wanted.validation, *wanted.test)
        source = fetch(subject, trials, cache or Path(DEFAULT_CACHE), allow_missing=allow_missing, report=note)
    experts = prepare(source, wanted, allow_missing=allow_missing)
    expert_sets.save(experts, out, force=force)
    _print_set(experts, out, as_json)


def _generate(environment: str, ctx: typer.Context, out: Path, force: bool, as_json: bool) -> None:
    """Generate the set of experiments.yaml with the given options, which are named like the keys of its section.

    Raises InputError for an invalid option.
    """
    from ssmail.config.experiments import build_spec
    from ssmail.config.names import METHODS
    from ssmail.data import expert_sets

    given = {key: value for key, value in ctx.params.items() if key not in ("out", "force", "as_json")}
    overrides = [f"data.{environment}.{key}={json.dumps(value)}" for key, value in given.items() if value is not None]
    data = build_spec(METHODS[0], environment, "quick", overrides, source="the options").data
    experts = expert_sets.generate(data, 0)
    expert_sets.save(experts, out, force=force)
    if as_json:
        write_json({"path": out, "hash": experts.hash, "parameters": experts.parameters}, None)
        return
    sizes = f"{len(experts.train)}/{len(experts.validation)}/{len(experts.test)}"
    say(f"wrote {out}: {sizes} training/validation/test trajectories, hash {experts.hash[:16]}")


def _print_set(experts: "ExpertSet", out: Path, as_json: bool) -> None:
    """Print what was written, and on stderr the trials that are missing."""
    windows = [len(split) for split in (experts.train, experts.validation, experts.test)]
    found = experts.scaling
    scaling = {
        "positions": (found.position_min, found.position_max),
        "velocities": (found.velocity_min, found.velocity_max),
    }
    missing = experts.parameters["missing"]
    assert isinstance(missing, list)
    if as_json:
        write_json(
            {
                "path": out,
                "hash": experts.hash,
                "windows": dict(zip(("train", "validation", "test"), windows, strict=True)),
                "scaling": scaling,
                "joints": experts.joints,
                "missing": missing,
                "parameters": experts.parameters,
                "sources": experts.sources,
            },
            None,
        )
    else:
        say(
            f"wrote {out}: {'/'.join(map(str, windows))} training/validation/test windows of "
            f"{len(experts.joints)} joints, hash {experts.hash[:16]}"
        )
        for what, (low, high) in scaling.items():
            say(f"training {what} from {low:#.6g} to {high:#.6g}")
    if missing:
        trials = ", ".join(f"{trial:02d}" for trial in missing)
        note(f"trials that do not exist and are not in the set: {trials}")
