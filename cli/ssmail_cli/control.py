"""`ssmail control`: the controls of experiments.yaml, listed, or trained as sweeps over arms and seeds."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import InputError, command_line
from ssmail.execution import LauncherName, Resume
from ssmail_cli import completion, launching, options
from ssmail_cli.artifacts import Artifacts
from ssmail_cli.launching import Launch
from ssmail_cli.options import parse_seeds
from ssmail_cli.output import chosen_format, note, print_rows
from ssmail_cli.sweep import finish, is_interrupted, leave, train_sweep

if TYPE_CHECKING:
    from ssmail_cli.progress import Sweep

COLUMNS = {name: name for name in ("control", "claim", "environment", "arms", "question")}


def control(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[list|all|NAME...]",
            help="Controls of experiments.yaml to train, all of them, or list: a table of what there is, also without "
            "a name.",
            autocompletion=completion.controls_and_words,
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
    """Train controls: experiments that switch off what a claim's verdict is credited to, arm by arm.

    A control asks one question, and compares its arms with the first one; docs/controls.md says what which result would
    mean. Each arm and seed make a run: finished runs are skipped, unfinished ones resumed, and an arm with the spec of
    `ssmail train` or `ssmail ablate` shares their runs. No claim, report or `ssmail reproduce` needs a control. Ctrl-C
    saves and stops.
    """
    from ssmail.config.controls import LISTED

    chosen = list(dict.fromkeys(names or [LISTED]))
    if LISTED in chosen:
        if len(chosen) > 1:
            raise InputError(f"{LISTED} shows every control; give it alone.")
        print_rows(_rows(), COLUMNS, chosen_format(as_json, None))
        return
    chosen = chosen_controls(chosen)
    sweep = _sweep(chosen, profile, parse_seeds(seeds), settings or [])
    if dry_run or enqueue_only:
        leave(sweep, db, resume, launcher, dry_run, as_json)
        return
    launch = Launch.of(jobs, resume, device, per_device, launcher, launcher_set)
    rows = train_sweep(sweep, db, launch, as_json, artifacts)
    if sys.stdout.isatty() and not is_interrupted(rows):
        command = command_line("ssmail", "plot", "control", *chosen, *options.database_words(db))
        note(f"`{command}` draws these runs")
    finish(sweep, rows)


def plot(
    ctx: typer.Context,
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME...", help="Controls of experiments.yaml, or all.", autocompletion=completion.controls
        ),
    ],
    metrics: Annotated[list[str] | None, options.metric_option("Draw", show_default="the control's own")] = None,
    profile: options.FigureProfile = None,
    settings: options.Settings = None,
    stat: Annotated[str | None, options.stat_option("median-iqr", "Centre and spread")] = None,
) -> None:
    """The arms of controls side by side, as `ssmail control NAME` trains them.

    All words after it are names of controls. Points are runs, beside them centre and spread of each arm. Notes and CSV
    have p of a two-sided exact test of each arm against the first. With --set, draws the runs that were trained so.
    With several names, those without runs are named on stderr; the exit code is then 3.
    """
    from ssmail.errors import ExitCode, stored_values
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import NoRuns, ablation
    from ssmail.plots import control as figure

    statistic, store = options.parse_statistic(stat) or Statistic.MEDIAN_IQR, options.open_store(ctx.obj.db)
    chosen, missing = chosen_controls(names), 0
    for name in chosen:
        try:
            found, selection = figure.select(store, name, profile, settings or [])
        except NoRuns as lacks:
            if len(chosen) == 1:
                raise
            note(str(lacks))
            missing += 1
            continue
        with stored_values(f"the control {name}"):
            record = figure.collect(store, found, selection, metrics, statistic)
            ctx.obj.save(f"control {name}", record.stem, record, ablation.draw(record.columns))
    if missing:
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


def chosen_controls(names: Sequence[str]) -> list[str]:
    """Return the named controls, each once; `all` stands for every one.

    Raises InputError for `all` and others, and for a control that is unknown or wrong.
    """
    from ssmail.config import controls

    chosen = list(dict.fromkeys(names))
    if controls.EVERY in chosen:
        if len(chosen) > 1:
            raise InputError(f"{controls.EVERY} is every control already; give it alone.")
        chosen = controls.control_names()
        if not chosen:
            raise InputError("the experiments.yaml in use has no controls; add some, or use the one of ssmail.")
    for name in chosen:
        controls.control(name)
    return chosen


def _rows() -> list[dict[str, Any]]:
    from ssmail.config import controls

    found = map(controls.control, controls.control_names())
    return [
        {
            "control": each.name,
            "claim": ", ".join(each.claims),
            "environment": each.environment,
            "arms": ", ".join(arm.name for arm in each.arms),
            "question": each.question,
        }
        for each in found
    ]


def _sweep(names: Sequence[str], profile: str, seeds: Sequence[int], settings: Sequence[str]) -> "Sweep":
    """Return the cells of all arms; a cell that several arms share is named after the first of them."""
    from ssmail.config.controls import arm_specs
    from ssmail.execution.cells import Cell

    sweep: dict[Cell, dict[str, Any]] = {}
    for name in names:
        for arm, spec in arm_specs(name, profile, settings).items():
            for seed in seeds:
                sweep.setdefault(Cell(spec, seed), {"control": name, "arm": arm, "seed": seed})
    return sweep
