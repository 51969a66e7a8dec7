"""`ssmail train` and `ssmail ablate`: sweeps over seeds, and over values of one key, into the store."""

import sys
from dataclasses import fields
from itertools import product
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from ssmail.errors import InputError, command_line, shortened
from ssmail.execution import Resume
from ssmail.paper.results import FIGURES
from ssmail_cli import completion, options
from ssmail_cli.options import parse_seeds, pick_device
from ssmail_cli.output import note
from ssmail_cli.sweep import finish, is_interrupted, print_plan, train_sweep


def train(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="METHOD", help="The methods to train, as with --method.", autocompletion=completion.methods
        ),
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="METHOD",
            help=f"The method to train: {options.METHOD_NAMES}; repeatable.",
            show_default="ssail",
            autocompletion=completion.methods,
        ),
    ] = None,
    environments: Annotated[
        list[str] | None,
        typer.Option(
            "--env",
            metavar="ENV",
            help=f"The environment to train on: {options.ENVIRONMENT_NAMES}; repeatable.",
            show_default="yjunction",
            autocompletion=completion.environments,
        ),
    ] = None,
    profile: options.TrainingProfile = "quick",
    seeds: options.Seeds = "0",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = options.AUTO,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Train methods with one or several seeds.

    A spec and a seed make a run: finished runs are skipped, unfinished ones resumed. Several methods or environments
    make one sweep, whose specs are all checked before the first run begins. Ctrl-C saves and stops.
    """
    from ssmail.config.experiments import build_spec
    from ssmail.execution.cells import Cell

    chosen_seeds = parse_seeds(seeds)
    chosen = list(dict.fromkeys([*(names or ()), *(methods or ())])) or ["ssail"]
    places = list(dict.fromkeys(environments or ())) or ["yjunction"]
    sweep: dict[Cell, dict[str, Any]] = {}
    for environment, method in product(places, chosen):
        spec = build_spec(method, environment, profile, settings or [])
        labels = {"method": method} if len(chosen) > 1 else {}
        labels |= {"environment": environment} if len(places) > 1 else {}
        sweep |= {Cell(spec, seed): {**labels, "seed": seed} for seed in chosen_seeds}
    if dry_run:
        print_plan(sweep, db, resume, as_json)
        return
    finish(sweep, train_sweep(sweep, db, jobs, resume, pick_device(device), as_json))


def ablate(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="alpha, beta, curriculum or label, or one of your experiments.yaml.",
            autocompletion=completion.ablations,
        ),
    ],
    values: Annotated[
        str | None,
        typer.Option(
            "--values",
            help="The values: 0,0.1,0.15 or [0,1],[-1,1] or identity,zero-above-one; each once.",
            show_default="those of experiments.yaml",
        ),
    ] = None,
    environment: Annotated[
        str | None,
        typer.Option(
            "--env",
            metavar="ENV",
            help=f"Train on this environment: {options.ENVIRONMENT_NAMES}.",
            show_default="the ablation's in experiments.yaml",
            autocompletion=completion.environments,
        ),
    ] = None,
    profile: options.TrainingProfile = "quick",
    seeds: options.Seeds = "0-4",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = options.AUTO,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Train a method for several values of one key of its spec.

    Each value and seed make a run: finished runs are skipped, unfinished ones resumed. Ctrl-C saves and stops. The
    ablations are entries of experiments.yaml; `ssmail ablate-beta` is short for `ssmail ablate beta`.
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


class AblateAlias(TyperCommand):
    """The command `ablate-beta`: `ablate` without its argument NAME, which is "beta"."""

    def __init__(self, name: str, *, params: list[Any], **settings: Any) -> None:
        super().__init__(name, params=[item for item in params if item.name != "name"], **settings)

    def invoke(self, ctx: Any) -> Any:
        """Run `ablate` with the name of the ablation."""
        ctx.params["name"] = str(self.name).removeprefix("ablate-")
        return super().invoke(ctx)


def parse_values(text: str) -> list[Any]:
    """ "0,0.1" -> [0, 0.1] and "[0,1],[-1,1]" -> [[0, 1], [-1, 1]], as a YAML list without its brackets.

    Raises InputError for an invalid or empty list, or an empty item.
    """
    import yaml

    from ssmail.config import strict_yaml

    try:
        values = strict_yaml.parse(f"[{text}\n]")  # the line ends a comment, which would hide the bracket
    except yaml.YAMLError:
        values = None
    if not values or None in values or text.rstrip().endswith(","):
        raise InputError(
            f"--values takes values with commas between them, such as 0,0.15,1, not '{shortened(text, 60)}'."
        )
    return list(values)


def _column(key: str) -> str:
    """Return the heading of the varied key: its last part, or all of it where that is the name of another column."""
    from ssmail.store import RunRow

    last = key.rpartition(".")[2]
    taken = {"name", "run", "outcome", "action", "message", *(field.name for field in fields(RunRow))}
    return key if last in taken else last


def _point_to_figures(name: str, environment: str | None, db: str) -> None:
    """Print the command for each figure that draws the ablation on that environment."""
    from ssmail.config.experiments import ablation, figure_requirements
    from ssmail.config.experiments_file import load_experiments

    trained = ablation(name, environment).environment
    database = () if db == options.DEFAULT_DATABASE else ("--db", db)
    for figure in load_experiments().figures:
        needed = figure_requirements(figure)
        own = needed.environment == trained
        if figure in FIGURES and needed.ablation == name and (own or FIGURES[figure].has_environment):
            where = () if own else ("--env", trained)
            note(f"`{command_line('ssmail', 'plot', figure, *where, *database)}` draws these runs")
