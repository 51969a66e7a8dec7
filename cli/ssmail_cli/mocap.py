"""`ssmail prep-mocap`: recorded walking as an expert set."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError
from ssmail_cli.output import note, write_json
from ssmail_cli.options import Json

if TYPE_CHECKING:
    from ssmail.data.trajectories import ExpertSet

DEFAULT_CACHE = "data/cmu"
SPLITS = ("train", "validation", "test")


def prep_mocap(
    source: Annotated[
        Path | None,
        typer.Option("--source", help="Folder or zip file that holds, at any depth, 35.asf and 35_01.amc ..."),
    ] = None,
    download: Annotated[
        bool, typer.Option("--download", help="Fetch the files from the CMU site instead, slowly, into --cache.")
    ] = False,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="With --download: where its files are kept.", show_default=DEFAULT_CACHE),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/mocap.npz"),
    subject: Annotated[int, typer.Option("--subject", min=1, max=999, help="Number of the subject.")] = 35,
    train: Annotated[str, typer.Option("--train", help="Trials to train on, as 01-12 or 1-3,7.")] = "01-12",
    validation: Annotated[str, typer.Option("--validation", "--val", help="Trials to validate on.")] = "13-16",
    test: Annotated[str, typer.Option("--test", help="Trials to test on.")] = "28-34",
    allow_missing: Annotated[
        bool, typer.Option("--allow-missing", help="Go on without the trials that are not there.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file when it exists.")] = False,
    as_json: Json = False,
) -> None:
    """Prepare the Noisy Mocap expert set from files of the CMU motion capture database.

    The trials are cut into windows of 50 frames, and of 100 for testing. The .npz holds positions and velocities of
    all joints in the files' own units, the skeleton, and where each window is from. Train on it with --env mocap.
    """
    from ssmail.data import expert_file
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
    expert_file.check_target(out, force=force)
    if source is None:
        from ssmail.data.mocap.download import fetch

        trials = (*wanted.train, *wanted.validation, *wanted.test)
        source = fetch(subject, trials, cache or Path(DEFAULT_CACHE), allow_missing=allow_missing)
    experts = prepare(source, wanted, allow_missing=allow_missing)
    expert_file.save(experts, out, force=force)
    _tell(experts, out, as_json)


def _tell(experts: "ExpertSet", out: Path, as_json: bool) -> None:
    """What was written, and what is not in it."""
    windows = {split: len(getattr(experts, split)) for split in SPLITS}
    scaling = experts.scaling
    positions, velocities = (
        (scaling.position_min, scaling.position_max),
        (scaling.velocity_min, scaling.velocity_max),
    )
    missing = experts.parameters["missing"]
    assert isinstance(missing, list)
    if as_json:
        write_json(
            {
                "path": out,
                "hash": experts.hash,
                "windows": windows,
                "scaling": {"positions": positions, "velocities": velocities},
                "joints": experts.joints,
                "missing": missing,
                "parameters": experts.parameters,
                "sources": experts.sources,
            },
            None,
        )
    else:
        typer.echo(
            f"wrote {out}: {'/'.join(map(str, windows.values()))} training/validation/test windows of "
            f"{len(experts.joints)} joints, hash {experts.hash[:16]}"
        )
        for what, (low, high) in (("positions", positions), ("velocities", velocities)):
            typer.echo(f"training {what} from {low:#.6g} to {high:#.6g}")
    if missing:
        trials = ", ".join(f"{trial:02d}" for trial in missing)
        note(f"trials that were asked for but are not there, so not in the set: {trials}")
