"""`ssmail plot`: figures of the paper, training curves and landscapes from the database alone; the skeleton."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError
from ssmail_cli.display import note
from ssmail_cli.drawing import INCOMPLETE, draw_all
from ssmail_cli.figure_options import ALL, DEFAULT_OUT, TRAINING, Formats, OutDir, check_formats, parse_statistic
from ssmail_cli.options import DEFAULT_DATABASE, Database, open_store
from ssmail_cli.results import SHOWN, shown_on

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ssmail.evaluation.statistics import Statistic
    from ssmail.paper.results import FigureModule
    from ssmail.plots import FigureRecord
    from ssmail.store import RunRow, Store

SKELETON = "skeleton"
OF_A_RUN = ("landscape", "film")
DEFAULT_GROUPS = "method"
DEFAULT_METRICS = "; ".join(f"{shown.curve} of {name}" for name, shown in SHOWN.items())
DEFAULT_DATA, DEFAULT_SPLIT = "data/mocap.npz", "test"


def plot(
    figures: Annotated[
        list[str],
        typer.Argument(
            metavar="FIGURE...",
            help="fig1 (landscapes), fig2 (vector-field), fig3 (curricula), fig4 (stability), fig5 (modes), "
            "fig6 (beta), fig7 (noise), fig8 (alpha), fig9 (yjunction), or all of these; training, landscape, film, "
            "skeleton.",
        ),
    ],
    out: OutDir = DEFAULT_OUT,
    formats: Formats = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--runs",
            metavar="RUN[,RUN...]",
            help="Draw these runs (ids or their first digits); repeatable.",
            show_default="those of experiments.yaml, else the spec with the most seeds; of training: all",
        ),
    ] = None,
    profile: Annotated[str | None, typer.Option("--profile", help="Only runs of this profile.")] = None,
    stat: Annotated[
        str | None,
        typer.Option(
            "--stat",
            help="Centre and band of fig3, fig4, fig6, fig7, fig8 and training: mean-std, median-iqr or mean-ci.",
            show_default="mean-std",
        ),
    ] = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option("--metric", help="training: draw this metric; repeatable.", show_default=DEFAULT_METRICS),
    ] = None,
    methods: Annotated[
        list[str] | None, typer.Option("--method", help="training: only runs of this method; repeatable.")
    ] = None,
    environment: Annotated[
        str | None,
        typer.Option("--env", help="training, fig8: runs on this environment.", show_default="any; of fig8 mocap"),
    ] = None,
    group_by: Annotated[
        str | None,
        typer.Option(
            "--group-by",
            help="training: method, seed, or a key of the spec such as curriculum.beta.",
            show_default=DEFAULT_GROUPS,
        ),
    ] = None,
    run: Annotated[
        str | None, typer.Option("--run", metavar="RUN", help="landscape, film: of this run (id or its first digits).")
    ] = None,
    epoch: Annotated[
        int | None,
        typer.Option("--epoch", min=0, help="landscape: after this epoch; 0 is untrained.", show_default="the last"),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option("--data", help="skeleton: the file that prep-mocap wrote.", show_default=DEFAULT_DATA),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option("--split", help="skeleton: train, validation or test.", show_default=DEFAULT_SPLIT),
    ] = None,
    window: Annotated[
        int | None, typer.Option("--window", min=0, help="skeleton: which window of the split.", show_default="0")
    ] = None,
    animate: Annotated[
        bool | None, typer.Option("--animate", help="skeleton: make a film (GIF) too.", show_default=False)
    ] = None,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Draw figures of the paper, the metrics of any runs over epochs (training), the learned reward of any planar run
    (landscape, film), or recorded walking (skeleton).

    Each comes with a CSV of exactly what it shows, and the ids of the runs stand in the metadata of the files. Prints
    the paths of the files. `all` draws the paper's figures as far as their runs are stored, tells of the others what
    makes their runs, and ends with exit code 3 when there are any.
    """
    from ssmail.paper.results import FIGURES

    ids = [part for text in runs or [] for part in text.split(",") if part] or None
    _check_figures(figures)
    check_formats(formats or [])
    training = {"--metric": metrics, "--method": methods, "--group-by": group_by}
    skeleton = {"--data": data, "--split": split, "--window": window, "--animate": animate}
    _check_owner([TRAINING], training, figures)
    _check_owner([SKELETON], skeleton, figures)
    _check_owner(OF_A_RUN, {"--run": run}, figures)
    _check_owner(OF_A_RUN[:1], {"--epoch": epoch}, figures)
    of_any = [key for key, module in FIGURES.items() if module.has_environment]
    _check_owner([TRAINING, *of_any], {"--env": environment}, figures)
    if ids and profile and figures != [TRAINING]:
        raise InputError("--runs names the runs already; leave --profile out.")
    statistic = parse_statistic(stat, figures)
    if ALL in figures:
        _draw_all(figures, ids, open_store(db), profile, statistic, out, formats)
        return
    names = dict.fromkeys(FIGURES[name].name if name in FIGURES else name for name in figures)
    _check_runs(list(names), ids, profile, run)
    store = open_store(db) if set(names) != {SKELETON} else None
    for name in names:
        if store is None or name == SKELETON:
            _draw_skeleton(data or Path(DEFAULT_DATA), split or DEFAULT_SPLIT, window or 0, bool(animate), out, formats)
        elif name == TRAINING:
            chosen = _chosen(store, ids, methods, environment, profile)
            usual = list(dict.fromkeys(shown_on(one.environment).curve for one in chosen))
            _draw_training(chosen, store, metrics or usual, group_by, statistic, out, formats)
        elif name in OF_A_RUN:
            _draw_run(name, str(run), epoch, store, out, formats)
        else:
            module = FIGURES[name]
            record = module.collect(store, ids, profile=profile, statistic=statistic, environment=environment)
            _save(name, _stem(module, environment), record, module.draw(record), out, formats)


def _draw_all(
    figures: Sequence[str],
    ids: Sequence[str] | None,
    store: "Store",
    profile: str | None,
    statistic: "Statistic | None",
    out: Path,
    formats: Sequence[str] | None,
) -> None:
    """The paper's figures, each if it can be drawn; raises Exit(INCOMPLETE) when one cannot."""
    if list(figures) != [ALL]:
        raise InputError(f"{ALL} is every figure of the paper already; give it alone.")
    if ids:
        raise InputError(f"{ALL} draws the runs of each figure; leave --runs out.")
    if any(drawn.lacks for drawn in draw_all(store, out, formats or ["png"], profile, statistic)):
        raise typer.Exit(INCOMPLETE)


def _check_runs(names: Sequence[str], ids: Sequence[str] | None, profile: str | None, run: str | None) -> None:
    """Refuse a choice of runs for figures that show none, or another one."""
    if set(names) <= {SKELETON, *OF_A_RUN} and (ids or profile):
        what = "the run of --run" if set(names) & set(OF_A_RUN) else "no runs"
        raise InputError(f"{names[0]} shows {what}; leave {'--runs' if ids else '--profile'} out.")
    for name in names:
        if name in OF_A_RUN and run is None:
            raise InputError(f"{name} shows one run; name it with --run (`ssmail runs list` shows those there are).")


def _check_figures(figures: Sequence[str]) -> None:
    """Refuse unknown names."""
    from ssmail.errors import unknown_name
    from ssmail.paper.results import FIGURES

    for name in figures:
        others = (ALL, TRAINING, SKELETON, *OF_A_RUN)
        if name not in FIGURES and name not in others:
            raise unknown_name("figure", name, [*FIGURES, *others])


def _check_owner(owners: Sequence[str], options: Mapping[str, object], figures: Sequence[str]) -> None:
    """Refuse the options of some figures beside others that know nothing of them."""
    given = [option for option, value in options.items() if value is not None]
    others = [name for name in figures if name not in owners]
    if given and others:
        names = " and ".join(f"`ssmail plot {owner}`" for owner in owners[:2])
        raise InputError(f"{given[0]} belongs to {names}; draw {', '.join(others)} without it.")


def _stem(module: "FigureModule", environment: str | None) -> str:
    """The files' name without ending; of another environment than the paper's it names that."""
    from ssmail.config.experiments import figure_requirements

    if environment in (None, figure_requirements(module.name).environment):
        return module.stem
    return f"{module.stem}_{environment}"


def _chosen(
    store: "Store",
    ids: Sequence[str] | None,
    methods: Sequence[str] | None,
    environment: str | None,
    profile: str | None,
) -> "list[RunRow]":
    """The runs that meet every condition, newest last. Raises InputError when there is none, or an unknown name."""
    from ssmail.config.experiments_file import load_experiments
    from ssmail.errors import unknown_name

    runs = store.runs(ids=ids, environment=environment, profile=profile)
    for method in methods or []:
        known = {run.method for run in store.runs()} | set(load_experiments().methods)
        if method not in known:
            raise unknown_name("method", method, sorted(known))
    runs = [run for run in runs if methods is None or run.method in methods]
    if not runs:
        raise InputError(f"no run in {store.where} meets these conditions; `ssmail runs list` shows those there are.")
    return runs


def _draw_training(
    runs: "list[RunRow]",
    store: "Store",
    metrics: Sequence[str],
    group_by: str | None,
    statistic: "Statistic | None",
    out: Path,
    formats: Sequence[str] | None,
) -> None:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.plots import training_curves

    record = training_curves.collect(store, runs, metrics, group_by or DEFAULT_GROUPS, statistic or Statistic.MEAN_STD)
    _save(TRAINING, record.stem, record, training_curves.draw(record), out, formats)


def _draw_run(name: str, run: str, epoch: int | None, store: "Store", out: Path, formats: Sequence[str] | None) -> None:
    """The landscape of a run, or the film of its landscapes."""
    from ssmail.plots import landscape_film

    record = landscape_film.collect(store, run, name, epoch)
    if name == landscape_film.LANDSCAPE:
        _save(name, record.stem, record, landscape_film.draw(record), out, formats)
        return
    for remark in record.notes:
        note(f"{name}: {remark}")
    typer.echo(landscape_film.save_film(record, out))


def _draw_skeleton(
    data: Path, split: str, window: int, animate: bool, out: Path, formats: Sequence[str] | None
) -> None:
    from ssmail.plots import skeleton

    record = skeleton.collect(data, split, window)
    _save(SKELETON, record.stem, record, skeleton.draw(record), out, formats)
    if animate:
        film = out / f"{record.stem}.gif"
        skeleton.save_film(record, film)
        typer.echo(film)


def _save(
    name: str, stem: str, record: "FigureRecord", figure: "Figure", out: Path, formats: Sequence[str] | None
) -> None:
    """Write the files, tell the notes on stderr and the paths on stdout."""
    from ssmail.plots.saving import save_figure

    for remark in record.notes:
        note(f"{name}: {remark}")
    for path in save_figure(stem, record, figure, out, formats or ["png"]):
        typer.echo(path)
