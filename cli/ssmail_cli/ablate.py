"""`ssmail ablate NAME`: one method for several values of one key, with seeds, in one sweep."""

import functools
import inspect
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Annotated, Any

import typer

from ssmail.errors import InputError
from ssmail.execution import Resume
from ssmail_cli import training_options as options
from ssmail_cli.display import note
from ssmail_cli.options import DEFAULT_DATABASE, Database, Json
from ssmail_cli.sweep import finish, is_interrupted, print_plan, train_sweep
from ssmail_cli.training_options import Device, parse_seeds, pick_device


def ablate(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="alpha, beta, curriculum or label, or one of your experiments.yaml.")
    ],
    values: Annotated[
        str | None,
        typer.Option(
            "--values",
            help="The values, as 0,0.1,0.15 or [0,1],[-1,1] or identity,zero-above-one; each once.",
            show_default="those of experiments.yaml",
        ),
    ] = None,
    environment: Annotated[
        str | None,
        typer.Option("--env", help="Train on this environment.", show_default="the ablation's in experiments.yaml"),
    ] = None,
    profile: options.ProfileName = "quick",
    seeds: options.Seeds = "0-4",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = Device.AUTO,
    dry_run: options.DryRun = False,
    as_json: Json = False,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Train a method for several values of one setting.

    A run for each value and seed: a finished one is skipped, an unfinished one is resumed. Ctrl-C saves and stops. Each
    ablation is an entry of experiments.yaml; `ssmail ablate-beta` is the same as `ssmail ablate beta`.
    """
    from ssmail.config.experiments import ablation, ablation_specs, display_value
    from ssmail.execution.cells import Cell

    chosen_seeds = parse_seeds(seeds)
    column = _column(ablation(name, environment).key)
    chosen_values = None if values is None else parse_values(values)
    specs = ablation_specs(name, profile, chosen_values, settings or [], environment=environment)
    sweep = {
        Cell(spec, seed): {column: display_value(value), "seed": seed}
        for value, spec in specs.items()
        for seed in chosen_seeds
    }
    if dry_run:
        print_plan(sweep, db, resume, as_json)
        return
    rows = train_sweep(sweep, db, jobs, resume, pick_device(device), as_json)
    if sys.stdout.isatty() and not is_interrupted(rows):
        _point_to_figures(name, environment, db)
    finish(sweep, rows)


def alias(name: str) -> Callable[..., None]:
    """The command `ablate` with its argument given."""

    @functools.wraps(ablate)
    def command(**given: Any) -> None:
        ablate(name, **given)

    signature = inspect.signature(ablate)
    parameters = [parameter for parameter in signature.parameters.values() if parameter.name != "name"]
    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # read by Typer
    command.__doc__ = f"Short for `ssmail ablate {name}`."
    return command


def parse_values(text: str) -> list[Any]:
    """ "0,0.1" -> [0, 0.1] and "[0,1],[-1,1]" -> [[0, 1], [-1, 1]], as YAML reads a list. Raises InputError where it
    reads none, or nothing between two commas.
    """
    import yaml

    from ssmail.config import strict_yaml

    try:
        values = strict_yaml.parse(f"[{text}\n]")  # the line ends a comment, which would hide the bracket
    except yaml.YAMLError:
        values = None
    if not values or None in values or text.rstrip().endswith(","):
        raise InputError(f"--values takes values with commas between them, such as 0,0.15,1, not '{text}'.")
    return list(values)


def _column(key: str) -> str:
    """What the result table calls the value: the key's last part, or all of it where that would be misread."""
    from ssmail.store import RunRow

    last = key.rpartition(".")[2]
    taken = {"name", "run", "outcome", "action", "message", *(field.name for field in fields(RunRow))}
    return key if last in taken else last


def _point_to_figures(name: str, environment: str | None, db: str) -> None:
    """A line for each figure that draws the ablation, on that environment."""
    from ssmail.config.experiments import ablation, figure_requirements
    from ssmail.config.experiments_file import load_experiments
    from ssmail.paper.results import FIGURES

    trained = ablation(name, environment).environment
    database = "" if db == DEFAULT_DATABASE else f" --db {db}"
    for figure in load_experiments().figures:
        needed = figure_requirements(figure)
        own = needed.environment == trained
        if figure in FIGURES and needed.ablation == name and (own or FIGURES[figure].has_environment):
            note(f"`ssmail plot {figure}{'' if own else f' --env {trained}'}{database}` draws these runs")
