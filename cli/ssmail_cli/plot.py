"""`ssmail plot`: a command for each thing that is drawn, with the options of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import ExitCode, InputError, stored_values, unknown_name
from ssmail.paper.results import FIGURES
from ssmail_cli import completion, control, options
from ssmail_cli.figure_group import ALL, FigureCommand, FigureGroup
from ssmail_cli.options import open_store, parse_statistic
from ssmail_cli.output import note, say
from ssmail_cli.report import draw_all
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.plots import FigureRecord
    from ssmail.store import RunRow, Store

EPILOG = "--out, --format and --db may be given too; see `ssmail plot --help`."


@dataclass(frozen=True)
class Destination:
    """The options that all commands have in common."""

    out: Path
    formats: Sequence[str]
    db: str

    def save(self, name: str, stem: str, record: "FigureRecord", figure: "Figure") -> None:
        """Write the files; print the notes on stderr and the paths on stdout."""
        from ssmail.plots.saving import save_figure

        _print_notes(name, record)
        for path in save_figure(stem, record, figure, self.out, self.formats):
            say(path)


app = typer.Typer(cls=FigureGroup, subcommand_metavar="NAME... [OPTIONS]", rich_markup_mode=None)


@app.callback()
def plot(
    ctx: typer.Context,
    out: options.OutDir = options.DEFAULT_OUT,
    formats: options.Formats = options.DEFAULT_FORMATS,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Draw figures of the paper, training curves, forecasts, reward landscapes and recorded walking.

    Give one name or several, as in `ssmail plot fig4 fig5 --format pdf`; `ssmail plot NAME --help` shows the options of
    each. A figure of the paper also goes by the name in parentheses. Each drawing comes with a CSV of exactly what it
    shows, and its files list the runs behind it in their metadata. Prints the paths of the files.
    """
    ctx.obj = Destination(out, formats, db)


def _split_ids(texts: list[str] | None) -> list[str] | None:
    """["ab,cd", "ef"] -> ["ab", "cd", "ef"]; None when there is none."""
    return [part for text in texts or [] for part in text.split(",") if part] or None


FigureRuns = Annotated[
    list[str] | None,
    typer.Option(
        "--runs",
        metavar="RUN[,RUN...]",
        callback=_split_ids,
        autocompletion=completion.run_ids,
        help="Draw these runs (ids or their first digits); repeatable.",
        show_default="those of experiments.yaml, else the spec with the most seeds",
    ),
]
OnlyRuns = Annotated[
    list[str] | None,
    typer.Option(
        "--runs",
        metavar="RUN[,RUN...]",
        callback=_split_ids,
        autocompletion=completion.run_ids,
        help="Only these runs (ids or their first digits); repeatable.",
    ),
]
Methods = Annotated[list[str] | None, options.method_option("Only runs of this method", "; repeatable")]
OneRun = Annotated[
    str,
    typer.Option(
        "--run",
        metavar="RUN",
        help="Id of the run or its first digits; see `ssmail runs list`.",
        autocompletion=completion.run_ids,
    ),
]


def figure(
    ctx: typer.Context,
    environment: Annotated[
        str | None, options.environment_option("Draw the runs on this environment", show_default="the paper's")
    ] = None,
    runs: FigureRuns = None,
    profile: options.Profile = None,
    stat: options.Stat = None,
) -> None:
    """Draw the figure that the command is called like."""
    from ssmail.config.experiments import figure_requirements

    module, to = FIGURES[str(ctx.info_name)], ctx.obj
    statistic, store = parse_statistic(stat), open_store(to.db)
    record = module.collect(store, runs, profile=profile, statistic=statistic, environment=environment)
    elsewhere = environment not in (None, figure_requirements(module.name).environment)
    to.save(module.name, f"{module.stem}_{environment}" if elsewhere else module.stem, record, module.draw(record))


for _module in dict.fromkeys(FIGURES.values()):
    _summary = f"({_module.alias}) {_module.summary[0].upper()}{_module.summary[1:]}."
    app.command(_module.name, cls=FigureCommand, help=_summary, epilog=EPILOG)(figure)


@app.command(ALL, epilog=EPILOG)
def every_figure(ctx: typer.Context, profile: options.Profile = None, stat: options.StatOfFigures = None) -> None:
    """Every figure of the paper whose runs are stored, and forecast and trajectories of each data set.

    For each of the others, prints on stderr the command that computes its runs; the exit code is then 3. Where all runs
    are on data of your own, the figures of the paper are left out.
    """
    to = ctx.obj
    if any(drawn.lacks for drawn in draw_all(open_store(to.db), to.out, to.formats, profile, parse_statistic(stat))):
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


@app.command(epilog=EPILOG)
def training(
    ctx: typer.Context,
    metrics: Annotated[
        list[str] | None,
        options.metric_option(
            "Draw", show_default="; ".join(f"{shown.curve} of {name}" for name, shown in ENVIRONMENT_METRICS.items())
        ),
    ] = None,
    methods: Methods = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    runs: OnlyRuns = None,
    group_by: Annotated[
        str, typer.Option("--group-by", help="method, seed, or a key of the spec such as curriculum.beta.")
    ] = "method",
    stat: options.Stat = None,
) -> None:
    """Any stored metric of any runs over epochs."""
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import training_curves

    statistic, store = parse_statistic(stat) or Statistic.MEAN_STD, open_store(ctx.obj.db)
    chosen = _chosen_runs(store, methods, ids=runs, environment=environment, profile=profile)
    metrics = metrics or list(dict.fromkeys(environment_metrics(run.environment).curve for run in chosen))
    with stored_values("these runs"):
        record = training_curves.collect(store, chosen, metrics, group_by, statistic)
        ctx.obj.save("training", record.stem, record, training_curves.draw(record))


def _chosen_runs(store: "Store", methods: Sequence[str] | None, **conditions: Any) -> "list[RunRow]":
    """Return the runs that meet every condition, newest last. Raises InputError for an unknown method or no run."""
    from ssmail.config.experiments_file import load_experiments

    for method in methods or []:
        known = {run.method for run in store.runs()} | set(load_experiments().methods)
        if method not in known:
            raise unknown_name("method", method, sorted(known))
    runs = [run for run in store.runs(**conditions) if methods is None or run.method in methods]
    if not runs:
        raise InputError(f"no run in {store.where} meets these conditions; `ssmail runs list` shows those there are.")
    return runs


@app.command(epilog=EPILOG)
def ablation(
    ctx: typer.Context,
    keys: Annotated[
        list[str],
        typer.Option(
            "--key",
            metavar="KEY",
            help="The key that varies, or the name of an ablation; a second one becomes colours.",
            autocompletion=completion.varied,
        ),
    ],
    metrics: Annotated[list[str] | None, options.metric_option("Draw", show_default="the test error")] = None,
    methods: Methods = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    where: options.Where = None,
    runs: OnlyRuns = None,
    stat: Annotated[str | None, options.stat_option("median-iqr", "Centre and spread")] = None,
) -> None:
    """Any metric against the values of a key of the spec, or of two, as `ssmail ablate KEY` trains them.

    Draws the runs that differ in these keys alone, of those the most; with --runs, all of these runs. Points are runs,
    beside them centre and spread of each value.
    """
    from ssmail.config.experiments_file import load_experiments
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import ablation as figure
    from ssmail.plots.varied_runs import select
    from ssmail.store.conditions import Condition, matching

    named = load_experiments().ablations
    keys = [str(named[key].get("key")) if key in named else key for key in keys]
    statistic, store = parse_statistic(stat) or Statistic.MEDIAN_IQR, open_store(ctx.obj.db)
    chosen = _chosen_runs(store, methods, ids=runs, environment=environment, profile=profile)
    chosen = matching(store, chosen, [Condition.parse(text) for text in where or ()])
    with stored_values("these runs"):
        selection = select(store, chosen, keys, named=bool(runs))
        shown = metrics or [environment_metrics(selection.runs[0].environment).error]
        record = figure.collect(store, selection, keys, shown, statistic)
        ctx.obj.save("ablation", record.stem, record, figure.draw(record))


@app.command(epilog=EPILOG)
def forecast(
    ctx: typer.Context,
    methods: Methods = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    runs: OnlyRuns = None,
    error: Annotated[
        str, typer.Option("--error", help="mse (scaled units) or distance (units of the data, where stored).")
    ] = "mse",
    stat: Annotated[str | None, options.stat_option("mean-ci")] = None,
) -> None:
    """The error of forecasts over the predicted steps, of any methods: a figure for each data set.

    Draws runs on recorded motion and on trajectories of your own. Of each method it takes the spec with the most seeds;
    with --runs, all of these runs, each spec by itself. Constant velocity and copies of the last state are drawn beside
    them.
    """
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import data_sets, forecast_curves

    statistic, store = parse_statistic(stat) or Statistic.MEAN_CI, open_store(ctx.obj.db)
    chosen = _chosen_runs(store, methods, ids=runs, environment=environment, profile=profile)
    for data in data_sets.required(store, "forecast", chosen):
        with stored_values(f"the runs on {data.name}"):
            selection = data.selection(named=bool(runs))
            record = forecast_curves.collect(store, data, selection, statistic, error)
            ctx.obj.save("forecast", record.stem, record, forecast_curves.draw(record))


@app.command(epilog=EPILOG)
def trajectories(
    ctx: typer.Context,
    run: OneRun,
    windows: Annotated[
        list[int] | None,
        typer.Option(
            "--window",
            min=0,
            help="Index in the test split, as in `ssmail forecast`, of a window that the run stored; repeatable.",
            show_default="the first four",
        ),
    ] = None,
) -> None:
    """Forecasts of a run: test windows as observed, their true future, and sampled futures.

    In one, two or three dimensions, for runs on recorded motion and on trajectories of your own.
    """
    from ssmail.plots import forecast_trajectories

    with stored_values(f"run {run}"):
        record = forecast_trajectories.collect(open_store(ctx.obj.db), run, windows)
        ctx.obj.save("trajectories", record.stem, record, forecast_trajectories.draw(record))


@app.command(epilog=EPILOG)
def landscape(
    ctx: typer.Context,
    run: OneRun,
    epoch: Annotated[
        int | None, typer.Option("--epoch", min=0, help="After this epoch; 0 is untrained.", show_default="the last")
    ] = None,
) -> None:
    """The learned reward of a run on a plane, after one epoch."""
    from ssmail.plots import landscape_film

    with stored_values(f"run {run}"):
        record = landscape_film.collect(open_store(ctx.obj.db), run, landscape_film.LANDSCAPE, epoch)
        ctx.obj.save("landscape", record.stem, record, landscape_film.draw(record))


@app.command(epilog=EPILOG)
def film(
    ctx: typer.Context,
    run: OneRun,
    window: Annotated[
        int | None,
        typer.Option("--window", min=0, help="Of a forecast: index of a stored test window.", show_default="the first"),
    ] = None,
) -> None:
    """The learned reward of a run on a plane, over training; or a forecast of a run, over its steps (GIF)."""
    from ssmail.plots import data_sets, forecast_film, landscape_film

    store = open_store(ctx.obj.db)
    (found,) = store.runs(ids=[run])
    with stored_values(f"run {run}"):
        if found.environment in data_sets.ENVIRONMENTS:
            forecast = forecast_film.collect(store, run, window)
            _print_notes("film", forecast)
            say(forecast_film.save_film(forecast, ctx.obj.out))
            return
        if window is not None:
            raise InputError(f"run {found.name} is on {found.environment}, whose film shows no window; leave it out.")
        record = landscape_film.collect(store, run, landscape_film.FILM)
        _print_notes("film", record)
        say(landscape_film.save_film(record, ctx.obj.out))


@app.command(epilog=EPILOG)
def skeleton(
    ctx: typer.Context,
    data: Annotated[Path, typer.Option("--data", help="The file that prep-mocap wrote.")] = Path("data/mocap.npz"),
    split: Annotated[str, typer.Option("--split", help="train, validation or test.")] = "test",
    window: Annotated[int, typer.Option("--window", min=0, help="Number of the window in the split.")] = 0,
    animate: Annotated[bool, typer.Option("--animate", help="Make a film (GIF) too.")] = False,
) -> None:
    """Recorded walking, from motion-capture data alone."""
    from ssmail.plots import skeleton as skeleton_plot

    record = skeleton_plot.collect(data, split, window)
    ctx.obj.save("skeleton", record.stem, record, skeleton_plot.draw(record))
    if animate:
        path = ctx.obj.out / f"{record.stem}.gif"
        skeleton_plot.save_film(record, path)
        say(path)


app.command("control", epilog=EPILOG)(control.plot)


def _print_notes(name: str, record: "FigureRecord") -> None:
    for remark in record.notes:
        note(f"{name}: {remark}")
