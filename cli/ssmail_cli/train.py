"""`ssmail train`: one spec, several seeds, into the store."""

from typing import Annotated

import typer

from ssmail.execution import Resume
from ssmail_cli import training_options as options
from ssmail_cli.options import DEFAULT_DATABASE, Database, Json
from ssmail_cli.sweep import finish, print_plan, train_sweep
from ssmail_cli.training_options import Device, parse_seeds, pick_device


def train(
    method: Annotated[str, typer.Option("--method", help="The method to train.")] = "ssail",
    environment: Annotated[str, typer.Option("--env", help="The environment to train on.")] = "yjunction",
    profile: options.ProfileName = "quick",
    seeds: options.Seeds = "0",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = Device.AUTO,
    dry_run: options.DryRun = False,
    as_json: Json = False,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Train a method for some seeds into the store.

    A run is its spec and its seed: a finished one is skipped, an unfinished one is resumed. Ctrl-C saves and stops.
    """
    from ssmail.config.experiments import build_spec
    from ssmail.execution.cells import Cell

    chosen_seeds = parse_seeds(seeds)
    spec = build_spec(method, environment, profile, settings or [])
    sweep = {Cell(spec, seed): {"seed": seed} for seed in chosen_seeds}
    if dry_run:
        print_plan(sweep, db, resume, as_json)
        return
    finish(sweep, train_sweep(sweep, db, jobs, resume, pick_device(device), as_json))
