"""`ssmail train` and `ssmail ablate`: sweeps over seeds, and over values of keys, into the store."""

import sys
from collections.abc import Sequence
from dataclasses import fields
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from ssmail.config.names import DEFAULT_ENVIRONMENT, DEFAULT_METHOD
from ssmail.errors import InputError, command_line, shortened
from ssmail.execution import LauncherName, Resume
from ssmail.paper.results import FIGURES
from ssmail.plots.formatting import counted
from ssmail_cli import completion, launching, options
from ssmail_cli.artifacts import Artifacts
from ssmail_cli.launching import Launch
from ssmail_cli.options import parse_seeds
from ssmail_cli.output import note
from ssmail_cli.sweep import finish, is_interrupted, leave, train_sweep

if TYPE_CHECKING:
    from ssmail.config.experiments import Axis
    from ssmail.config.spec import RunSpec


def train(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="METHOD", help="The methods to train, as with --method.", autocompletion=completion.methods
        ),
    ] = None,
    methods: Annotated[
        list[str] | None,
        options.method_option("The method to train", "; repeatable", show_default=DEFAULT_METHOD),
    ] = None,
    environments: Annotated[
        list[str] | None,
        options.environment_option("The environment to train on", "; repeatable", show_default=DEFAULT_ENVIRONMENT),
    ] = None,
    profile: options.TrainingProfile = "quick",
    seeds: options.Seeds = "0",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = options.AUTO,
    per_device: options.PerDevice = 1,
    launcher: launching.Name = LauncherName.LOCAL,
    launcher_set: launching.Settings = None,
    enqueue_only: options.Enqueue = False,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    artifacts: Artifacts = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Train methods with one or several seeds.

    A spec and a seed make a run: finished runs are skipped, unfinished ones resumed. Several methods or environments
    make one sweep, whose specs are all checked before the first run begins. Ctrl-C saves and stops. The same command in
    several terminals shares the runs among them.
    """
    from ssmail.config.experiments import build_spec
    from ssmail.execution.cells import Cell

    chosen_seeds = parse_seeds(seeds)
    chosen = list(dict.fromkeys([*(names or ()), *(methods or ())])) or [DEFAULT_METHOD]
    places = list(dict.fromkeys(environments or ())) or [DEFAULT_ENVIRONMENT]
    sweep: dict[Cell, dict[str, Any]] = {}
    for environment, method in product(places, chosen):
        spec = build_spec(method, environment, profile, settings or [])
        labels = {"method": method} if len(chosen) > 1 else {}
        labels |= {"environment": environment} if len(places) > 1 else {}
        sweep |= {Cell(spec, seed): {**labels, "seed": seed} for seed in chosen_seeds}
    if dry_run or enqueue_only:
        leave(sweep, db, resume, launcher, dry_run, as_json)
        return
    launch = Launch.of(jobs, resume, device, per_device, launcher, launcher_set)
    finish(sweep, train_sweep(sweep, db, launch, as_json, artifacts))


def ablate(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME|KEY...",
            help="What varies: alpha, beta, curriculum, label or an ablation of your experiments.yaml, or any key of "
            "the spec (`ssmail config keys`); several make a grid.",
            autocompletion=completion.varied,
        ),
    ],
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--values",
            help="The values: 0,0.1,0.15 or [0,1],[-1,1] or identity,zero-above-one; each once. In a grid, repeat it "
            "for each name in turn, or write KEY=0.8,0.9.",
            show_default="those of experiments.yaml",
        ),
    ] = None,
    method: Annotated[
        str | None,
        options.method_option("Train this method", show_default=f"the ablation's, and {DEFAULT_METHOD} for a key"),
    ] = None,
    environment: Annotated[
        str | None,
        options.environment_option(
            "Train on this environment", show_default=f"the ablation's, and {DEFAULT_ENVIRONMENT} for a key"
        ),
    ] = None,
    profile: options.TrainingProfile = "quick",
    seeds: options.Seeds = "0-4",
    jobs: options.Jobs = 1,
    settings: options.Settings = None,
    resume: options.ResumeOption = Resume.AUTO,
    device: options.DeviceOption = options.AUTO,
    per_device: options.PerDevice = 1,
    launcher: launching.Name = LauncherName.LOCAL,
    launcher_set: launching.Settings = None,
    enqueue_only: options.Enqueue = False,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    artifacts: Artifacts = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Train a method for several values of one key of its spec, or for a grid of values of several keys.

    `ssmail ablate sac.gamma --values 0.9,0.95,0.99` varies any key; `ssmail ablate sac.gamma=0.9,0.95
    curriculum.beta=0,0.15` all combinations of two. Entries of experiments.yaml have a name, values and settings of
    their own; `ssmail ablate-beta` is short for `ssmail ablate beta`. Each value and seed make a run: finished runs are
    skipped, unfinished ones resumed. Ctrl-C saves and stops.
    """
    from ssmail.config.experiments import display_value, grid_specs
    from ssmail.execution.cells import Cell

    chosen_seeds = parse_seeds(seeds)
    grid = grid_specs(_axes(names, values or ()), profile, settings or [], method=method, environment=environment)
    columns = _columns(grid.keys)
    sweep = {
        Cell(spec, seed): {**dict(zip(columns, map(display_value, varied), strict=True)), "seed": seed}
        for varied, spec in grid.specs.items()
        for seed in chosen_seeds
    }
    if dry_run or enqueue_only:
        leave(sweep, db, resume, launcher, dry_run, as_json)
        return
    launch = Launch.of(jobs, resume, device, per_device, launcher, launcher_set)
    rows = train_sweep(sweep, db, launch, as_json, artifacts)
    if sys.stdout.isatty() and not is_interrupted(rows):
        _point_to_figures(names, grid.keys, next(iter(grid.specs.values())), db)
    finish(sweep, rows)


class AblateAlias(TyperCommand):
    """The command `ablate-beta`: `ablate` without its argument, which is "beta"."""

    def __init__(self, name: str, *, params: list[Any], **settings: Any) -> None:
        super().__init__(name, params=[item for item in params if item.name != "names"], **settings)

    def invoke(self, ctx: Any) -> Any:
        """Run `ablate` with the name of the ablation."""
        ctx.params["names"] = [str(self.name).removeprefix("ablate-")]
        return super().invoke(ctx)


def _axes(names: Sequence[str], values: Sequence[str]) -> "list[Axis]":
    """Return what varies: names with their --values in turn, and KEY=V1,V2. Raises InputError where the two differ."""
    from ssmail.config.experiments import Axis

    bare = [name for name in names if "=" not in name]
    if values and len(values) != len(bare):
        raise InputError(
            f"--values is given {counted(len(values), 'time')} for {counted(len(bare), 'name')}; give it once for "
            "each, in the same order, or write KEY=V1,V2."
        )
    rest, axes = iter(values), []
    for name in names:
        key, equals, given = name.partition("=")
        text = given if equals else next(rest, None)
        axes.append(Axis(key.strip(), None if text is None else parse_values(text)))
    return axes


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
    if not values or text.rstrip().endswith(","):
        raise InputError(
            f"--values takes values with commas between them, such as 0,0.15,1, not '{shortened(text, 60)}'."
        )
    return list(values)


def _columns(keys: Sequence[str]) -> list[str]:
    """Return the heading of each varied key: its last part, or all of it where another column has that name."""
    from ssmail.store import RunRow

    last = [key.rpartition(".")[2] for key in keys]
    taken = {"name", "run", "outcome", "action", "message", *(field.name for field in fields(RunRow))}
    return [key if part in taken or last.count(part) > 1 else part for key, part in zip(keys, last, strict=True)]


def _point_to_figures(names: Sequence[str], keys: Sequence[str], trained: "RunSpec", db: str) -> None:
    """Print the command for each figure of the paper that draws these runs, else the one that draws any ablation."""
    from ssmail.config.experiments import figure_requirements
    from ssmail.config.experiments_file import load_experiments

    commands = []
    for figure in load_experiments().figures:
        needed = figure_requirements(figure)
        own = needed.environment == trained.environment
        drawn = [needed.ablation] == list(names) and trained.method in needed.methods
        if figure in FIGURES and drawn and (own or FIGURES[figure].has_environment):
            commands.append((figure, *(() if own else ("--env", trained.environment))))
    if not commands:
        where = ("--env", trained.environment) if trained.environment != DEFAULT_ENVIRONMENT else ()
        which = ("--method", trained.method) if trained.method != DEFAULT_METHOD else ()
        commands.append(("ablation", *(word for key in keys for word in ("--key", key)), *which, *where))
    for command in commands:
        note(f"`{command_line('ssmail', 'plot', *command, *options.database_words(db))}` draws these runs")
