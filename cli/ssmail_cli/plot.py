"""`ssmail plot`: a command for each thing that is drawn, with the options of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ssmail.errors import ExitCode, InputError, stored_values, unknown_name
from ssmail.paper.results import FIGURES
from ssmail_cli import options
from ssmail_cli.options import open_store, parse_statistic
from ssmail_cli.output import note, say
from ssmail_cli.report import draw_all
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.plots import FigureRecord
    from ssmail.store import RunRow, Store

ALL = "all"
EPILOG = "--out, --format and --db may be given too; see `ssmail plot --help`."


class FigureGroup(TyperGroup):
    """A group whose command line may name several things to draw, with options before, between and after the names.

    `plot fig4 --out X fig5 --profile quick` is read as `plot --out X` followed by the lines `fig4 --profile quick` and
    `fig5 --profile quick`: the group has the options in common, and every command parses all the others, so click
    refuses one that the command does not have. Only an option in SHARED may be meant for some of the commands alone.
    """

    SHARED = frozenset({"--runs", "--profile", "--stat"})

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Split the line, and let click parse the options in common and, for a single command, its line."""
        names, given = self._split(args, ctx.resilient_parsing)
        common = {option for parameter in self.params for option in parameter.opts}
        own = {key: tokens for key, tokens in given.items() if key not in common}
        lines = ctx.meta["lines"] = [[name, *self._options_of(name, names, own)] for name in names]
        first = lines[0] if lines else [token for tokens in own.values() for token in tokens]
        return super().parse_args(ctx, [*(token for key in given if key in common for token in given[key]), *first])

    def invoke(self, ctx: Any) -> None:
        """Parse the line of every command, then run the commands."""
        lines = ctx.meta["lines"]
        if not lines:
            super().invoke(ctx)  # fails with "Missing command."
        for name, *_ in lines:
            if name not in self.commands:
                raise unknown_name("figure", name, [*FIGURES, *self.commands])
        if len(lines) > 1 and any(name == ALL for name, *_ in lines):
            raise InputError(f"{ALL} is every figure of the paper already; give it alone.")
        super(TyperGroup, self).invoke(ctx)  # the callback of the group
        contexts = [self.commands[name].make_context(name, line, parent=ctx) for name, *line in lines]
        for context in contexts:
            with context:
                context.command.invoke(context)

    def _split(self, args: Sequence[str], completing: bool) -> tuple[list[str], dict[str, list[str]]]:
        """Return the names, without aliases and repetitions, and the tokens of each option by its key, as --out.

        Raises InputError for an option without its value, except when the shell is completing the line.
        """
        parameters = [*self.params, *(parameter for command in self.commands.values() for parameter in command.params)]
        is_flag = {key: getattr(parameter, "is_flag", False) for parameter in parameters for key in parameter.opts}
        is_flag |= {"-h": True, "--help": True}
        names: dict[str, None] = {}
        given: dict[str, list[str]] = {}
        tokens = iter(args)
        for token in tokens:
            if not token.startswith("-"):
                names[FIGURES[token].name if token in FIGURES else token] = None
                continue
            option = given.setdefault(token.partition("=")[0], [])
            option.append(token)
            if "=" not in token and not is_flag.get(token):
                value = next(tokens, None)
                if value is not None:
                    option.append(value)
                elif token in is_flag and not completing:
                    raise InputError(f"option '{token}' requires an argument.")
        return list(names), given

    def _options_of(self, name: str, names: Sequence[str], given: dict[str, list[str]]) -> list[str]:
        """Return the tokens for one of the commands: all but SHARED options that only others of them have."""
        options = {
            other: {key for parameter in self.commands[other].params for key in parameter.opts}
            for other in names
            if other in self.commands
        }
        for_others = self.SHARED & set().union(*options.values()) - options.get(name, set())
        return [token for key, tokens in given.items() if key not in for_others for token in tokens]


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
    """Draw figures of the paper, training curves, reward landscapes and recorded walking.

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
        help="Draw these runs (ids or their first digits); repeatable.",
        show_default="those of experiments.yaml, else the spec with the most seeds",
    ),
]
OneRun = Annotated[
    str, typer.Option("--run", metavar="RUN", help="Id of the run or its first digits; see `ssmail runs list`.")
]


class FigureCommand(TyperCommand):
    """The command of a figure of the paper, without the options that the figure does not have.

    What does not go together is refused while the options are parsed, before anything is drawn.
    """

    def __init__(self, name: str, *, params: list[Any], **settings: Any) -> None:
        module = FIGURES[name]
        lacks = {"environment": not module.has_environment, "stat": not module.has_statistic}
        super().__init__(name, params=[item for item in params if not lacks.get(item.name)], **settings)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options. Raises InputError for two choices of runs."""
        rest = super().parse_args(ctx, args)
        if ctx.params["runs"] and ctx.params["profile"]:
            raise InputError("--runs names the runs already; leave --profile out.")
        return rest


def figure(
    ctx: typer.Context,
    environment: Annotated[
        str | None, typer.Option("--env", help="Draw the runs on this environment.", show_default="the paper's")
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
def every_figure(ctx: typer.Context, profile: options.Profile = None, stat: options.Stat = None) -> None:
    """Every figure of the paper whose runs are stored.

    For each of the others, prints on stderr the command that computes its runs; the exit code is then 3.
    """
    to = ctx.obj
    if any(drawn.lacks for drawn in draw_all(open_store(to.db), to.out, to.formats, profile, parse_statistic(stat))):
        raise typer.Exit(ExitCode.SOME_RUNS_FAILED)


@app.command(epilog=EPILOG)
def training(
    ctx: typer.Context,
    metrics: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            help="Draw this metric; repeatable.",
            show_default="; ".join(f"{shown.curve} of {name}" for name, shown in ENVIRONMENT_METRICS.items()),
        ),
    ] = None,
    methods: Annotated[list[str] | None, typer.Option("--method", help="Only runs of this method; repeatable.")] = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--runs",
            metavar="RUN[,RUN...]",
            callback=_split_ids,
            help="Only these runs (ids or their first digits); repeatable.",
        ),
    ] = None,
    group_by: Annotated[
        str, typer.Option("--group-by", help="method, seed, or a key of the spec such as curriculum.beta.")
    ] = "method",
    stat: options.Stat = None,
) -> None:
    """Any stored metric of any runs over epochs."""
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import training_curves

    statistic, store = parse_statistic(stat) or Statistic.MEAN_STD, open_store(ctx.obj.db)
    chosen = _training_runs(store, methods, ids=runs, environment=environment, profile=profile)
    metrics = metrics or list(dict.fromkeys(environment_metrics(run.environment).curve for run in chosen))
    with stored_values("these runs"):
        record = training_curves.collect(store, chosen, metrics, group_by, statistic)
        ctx.obj.save("training", record.stem, record, training_curves.draw(record))


def _training_runs(store: "Store", methods: Sequence[str] | None, **conditions: Any) -> "list[RunRow]":
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
def film(ctx: typer.Context, run: OneRun) -> None:
    """The learned reward of a run on a plane, over training (GIF)."""
    from ssmail.plots import landscape_film

    with stored_values(f"run {run}"):
        record = landscape_film.collect(open_store(ctx.obj.db), run, landscape_film.FILM)
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


def _print_notes(name: str, record: "FigureRecord") -> None:
    for remark in record.notes:
        note(f"{name}: {remark}")
