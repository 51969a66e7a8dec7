"""`ssmail plot`: a command for each thing that is drawn, with the options of its own."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from ssmail.errors import InputError, unknown_name
from ssmail.paper.results import FIGURES
from ssmail_cli.output import note
from ssmail_cli.drawing import INCOMPLETE, draw_all
from ssmail_cli.figure_options import DEFAULT_FORMATS, DEFAULT_OUT, Formats, OutDir, Stat, parse_statistic
from ssmail_cli.options import DEFAULT_DATABASE, Database, Environment, Profile, open_store
from ssmail_cli.run_table import SHOWN, shown_on

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.plots import FigureRecord
    from ssmail.store import RunRow, Store

ALL = "all"
DEFAULT_METRICS = "; ".join(f"{shown.curve} of {name}" for name, shown in SHOWN.items())
FIGURE_RUNS = "those of experiments.yaml, else the spec with the most seeds"


class FigureGroup(TyperGroup):
    """A group whose command line may name several things to draw, with options before, between and after the names.

    `plot --out X fig4 fig5 --format pdf` runs `fig4 --out X --format pdf` and `fig5 --out X --format pdf`. The options
    of every command are parsed before anything is drawn. An option that one of the commands does not have is an error,
    except those in SHARED: they apply to the commands that have them.
    """

    SHARED = frozenset({"--runs", "--profile", "--stat", "--format", "--db"})

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Split the line into one line per command, and let click read the first, as it would for any group."""
        names, options = self._split(args)
        lines = ctx.meta["lines"] = [[name, *self._options_of(name, names, options)] for name in names]
        return super().parse_args(ctx, lines[0] if lines else args)

    def invoke(self, ctx: Any) -> None:
        """Parse each line with the command that it names, then run the commands."""

        lines = ctx.meta["lines"]
        if not lines:
            super().invoke(ctx)  # fails with "Missing command."
        for name, *_ in lines:
            if name not in self.commands:
                raise unknown_name("figure", name, [*FIGURES, *self.commands])
        if len(lines) > 1 and any(name == ALL for name, *_ in lines):
            raise InputError(f"{ALL} is every figure of the paper already; give it alone.")
        contexts = [self.commands[name].make_context(name, options, parent=ctx) for name, *options in lines]
        for context in contexts:
            with context:
                context.command.invoke(context)

    def _split(self, args: Sequence[str]) -> tuple[list[str], list[list[str]]]:
        """Return the names, aliases resolved and each once, and the options, each with its value."""
        flags = {"-h", "--help"} | {
            option
            for command in self.commands.values()
            for parameter in command.params
            if getattr(parameter, "is_flag", False)
            for option in parameter.opts
        }
        names: list[str] = []
        options: list[list[str]] = []
        tokens = iter(args)
        for token in tokens:
            if not token.startswith("-"):
                names.append(FIGURES[token].name if token in FIGURES else token)
            elif token in flags or "=" in token:
                options.append([token])
            else:
                options.append([token, *(value for value in [next(tokens, None)] if value is not None)])
        return list(dict.fromkeys(names)), options

    def _options_of(self, name: str, names: Sequence[str], options: Sequence[Sequence[str]]) -> list[str]:
        """Return the options for one of the names: all but those in SHARED that only others of the names have."""

        def has(command: str, option: str) -> bool:
            parameters = self.commands[command].params if command in self.commands else []
            return any(option in parameter.opts for parameter in parameters)

        line: list[str] = []
        for option in options:
            key = option[0].partition("=")[0]
            if has(name, key) or key not in self.SHARED or not any(has(other, key) for other in names):
                line.extend(option)
        return line


app = typer.Typer(
    cls=FigureGroup,
    help="Draw figures of the paper, training curves, reward landscapes and recorded walking.\n\n"
    "Give one name or several, as in `ssmail plot fig4 fig5 --format pdf`. A figure of the paper also goes by the name "
    "in parentheses. Each drawing comes with a CSV of exactly what it shows, and its files list the runs behind it in "
    "their metadata. Prints the paths of the files.",
    subcommand_metavar="NAME... [OPTIONS]",
    rich_markup_mode=None,
)


def _run_ids(texts: list[str] | None) -> list[str] | None:
    """["ab,cd", "ef"] -> ["ab", "cd", "ef"]."""
    return [part for text in texts or [] for part in text.split(",") if part] or None


FigureRuns = Annotated[
    list[str] | None,
    typer.Option(
        "--runs",
        metavar="RUN[,RUN...]",
        callback=_run_ids,
        help="Draw these runs (ids or their first digits); repeatable.",
        show_default=FIGURE_RUNS,
    ),
]
OneRun = Annotated[
    str, typer.Option("--run", metavar="RUN", help="Id of the run or its first digits; see `ssmail runs list`.")
]


def figure(
    ctx: typer.Context,
    runs: FigureRuns = None,
    profile: Profile = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Draw a figure without a centre and band."""
    _draw_figure(str(ctx.info_name), runs, profile, out, formats, db)


def figure_with_statistic(
    ctx: typer.Context,
    runs: FigureRuns = None,
    profile: Profile = None,
    stat: Stat = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Draw a figure with a centre and band."""
    _draw_figure(str(ctx.info_name), runs, profile, out, formats, db, stat)


def figure_on_environment(
    ctx: typer.Context,
    runs: FigureRuns = None,
    environment: Annotated[
        str | None, typer.Option("--env", help="Draw the runs on this environment.", show_default="the paper's")
    ] = None,
    profile: Profile = None,
    stat: Stat = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Draw a figure with a centre and band, on another environment than the paper's if wanted."""
    _draw_figure(str(ctx.info_name), runs, profile, out, formats, db, stat, environment)


def _add_figures() -> None:
    """Add a command for each figure of the paper, with the options that the figure has."""
    for module in dict.fromkeys(FIGURES.values()):
        draw: Callable[..., None] = figure_with_statistic if module.has_statistic else figure
        if module.has_environment:
            draw = figure_on_environment
        app.command(module.name, help=f"({module.alias}) {module.summary[0].upper()}{module.summary[1:]}.")(draw)


_add_figures()


def _draw_figure(
    name: str,
    runs: Sequence[str] | None,
    profile: str | None,
    out: Path,
    formats: Sequence[str],
    db: str,
    stat: str | None = None,
    environment: str | None = None,
) -> None:
    from ssmail.config.experiments import figure_requirements

    if runs and profile:
        raise InputError("--runs names the runs already; leave --profile out.")
    module, statistic = FIGURES[name], parse_statistic(stat)
    record = module.collect(open_store(db), runs, profile=profile, statistic=statistic, environment=environment)
    elsewhere = environment is not None and environment != figure_requirements(name).environment
    _save(name, f"{module.stem}_{environment}" if elsewhere else module.stem, record, module.draw(record), out, formats)


@app.command(ALL)
def all_figures(
    profile: Profile = None,
    stat: Stat = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Every figure of the paper whose runs are stored.

    For each of the others, prints the command that computes its runs on stderr, and ends with exit code 3.
    """
    if any(drawn.lacks for drawn in draw_all(open_store(db), out, formats, profile, parse_statistic(stat))):
        raise typer.Exit(INCOMPLETE)


@app.command()
def training(
    metrics: Annotated[
        list[str] | None,
        typer.Option("--metric", help="Draw this metric; repeatable.", show_default=DEFAULT_METRICS),
    ] = None,
    methods: Annotated[list[str] | None, typer.Option("--method", help="Only runs of this method; repeatable.")] = None,
    environment: Environment = None,
    profile: Profile = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--runs",
            metavar="RUN[,RUN...]",
            callback=_run_ids,
            help="Only these runs (ids or their first digits); repeatable.",
        ),
    ] = None,
    group_by: Annotated[
        str, typer.Option("--group-by", help="method, seed, or a key of the spec such as curriculum.beta.")
    ] = "method",
    stat: Stat = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Any stored metric of any runs over epochs."""
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import training_curves

    store = open_store(db)
    chosen = _training_runs(store, runs, methods, environment, profile)
    metrics = metrics or list(dict.fromkeys(shown_on(run.environment).curve for run in chosen))
    record = training_curves.collect(store, chosen, metrics, group_by, parse_statistic(stat) or Statistic.MEAN_STD)
    _save("training", record.stem, record, training_curves.draw(record), out, formats)


def _training_runs(
    store: "Store",
    ids: Sequence[str] | None,
    methods: Sequence[str] | None,
    environment: str | None,
    profile: str | None,
) -> "list[RunRow]":
    """Return the runs that meet every condition, newest last. Raises InputError for an unknown method or no run."""
    from ssmail.config.experiments_file import load_experiments

    runs = store.runs(ids=ids, environment=environment, profile=profile)
    for method in methods or []:
        known = {run.method for run in store.runs()} | set(load_experiments().methods)
        if method not in known:
            raise unknown_name("method", method, sorted(known))
    runs = [run for run in runs if methods is None or run.method in methods]
    if not runs:
        raise InputError(f"no run in {store.where} meets these conditions; `ssmail runs list` shows those there are.")
    return runs


@app.command()
def landscape(
    run: OneRun,
    epoch: Annotated[
        int | None, typer.Option("--epoch", min=0, help="After this epoch; 0 is untrained.", show_default="the last")
    ] = None,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """The learned reward of a run on a plane, after one epoch."""
    from ssmail.plots import landscape_film

    record = landscape_film.collect(open_store(db), run, landscape_film.LANDSCAPE, epoch)
    _save("landscape", record.stem, record, landscape_film.draw(record), out, formats)


@app.command()
def film(run: OneRun, out: OutDir = DEFAULT_OUT, db: Database = DEFAULT_DATABASE) -> None:
    """The learned reward of a run on a plane, over training (GIF)."""
    from ssmail.plots import landscape_film

    record = landscape_film.collect(open_store(db), run, landscape_film.FILM)
    _print_notes("film", record)
    typer.echo(landscape_film.save_film(record, out))


@app.command()
def skeleton(
    data: Annotated[Path, typer.Option("--data", help="The file that prep-mocap wrote.")] = Path("data/mocap.npz"),
    split: Annotated[str, typer.Option("--split", help="train, validation or test.")] = "test",
    window: Annotated[int, typer.Option("--window", min=0, help="Number of the window in the split.")] = 0,
    animate: Annotated[bool, typer.Option("--animate", help="Make a film (GIF) too.")] = False,
    out: OutDir = DEFAULT_OUT,
    formats: Formats = DEFAULT_FORMATS,
) -> None:
    """Recorded walking, from the motion-capture data alone."""
    from ssmail.plots import skeleton as skeleton_plot

    record = skeleton_plot.collect(data, split, window)
    _save("skeleton", record.stem, record, skeleton_plot.draw(record), out, formats)
    if animate:
        path = out / f"{record.stem}.gif"
        skeleton_plot.save_film(record, path)
        typer.echo(path)


def _save(name: str, stem: str, record: "FigureRecord", drawn: "Figure", out: Path, formats: Sequence[str]) -> None:
    """Write the files; print the notes on stderr and the paths on stdout."""
    from ssmail.plots.saving import save_figure

    _print_notes(name, record)
    for path in save_figure(stem, record, drawn, out, formats):
        typer.echo(path)


def _print_notes(name: str, record: "FigureRecord") -> None:
    for remark in record.notes:
        note(f"{name}: {remark}")
