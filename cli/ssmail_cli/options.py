"""Options that several commands share, what the shell completes of them, and the functions that read their values."""

import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.config.names import ENVIRONMENTS, METHODS
from ssmail.errors import InputError, SsmailError, command_line, shortened, suggestion, unknown_name
from ssmail.execution import Resume
from ssmail.paper.results import FIGURES
from ssmail.plots.formatting import counted, listed
from ssmail_cli import completion
from ssmail_cli.output import Format, note_at_end

if TYPE_CHECKING:
    from ssmail.evaluation.statistics import Statistic
    from ssmail.store import RunRow, Store

DEFAULT_DATABASE = "results/ssmail.db"
DEFAULT_OUT = Path("results/figures")
DEFAULT_FORMATS = ["png"]
MOST_SEEDS = 1000
STATES = ("queued", "running", "finished", "failed", "diverged", "interrupted")
AUTO = "auto"
DEVICES = (AUTO, "cpu", "cuda")
_DEVICE = re.compile(r"auto|cpu|cuda(:\d{1,3})?", re.ASCII)


def method_option(what: str, more: str = "", **shown: Any) -> Any:
    """Return the option --method. Its help is `what`, the methods, and `more`."""
    text = f"{what}: {listed(METHODS)}{more}."
    return typer.Option("--method", metavar="METHOD", help=text, autocompletion=completion.methods, **shown)


def environment_option(what: str, more: str = "", **shown: Any) -> Any:
    """Return the option --env. Its help is `what`, the environments, and `more`."""
    text = f"{what}: {listed(ENVIRONMENTS)}{more}."
    return typer.Option("--env", metavar="ENV", help=text, autocompletion=completion.environments, **shown)


def _profile_option(**shown: Any) -> Any:
    text = "Only runs of this profile: smoke, quick, standard, paper, or one of your experiments.yaml."
    return typer.Option("--profile", metavar="PROFILE", help=text, autocompletion=completion.profiles, **shown)


def metric_option(verb: str, **shown: Any) -> Any:
    """Return the repeatable option --metric. `verb`: what the command does with the metrics."""
    text = f"{verb} this metric, which `ssmail runs show RUN` lists; repeatable."
    return typer.Option("--metric", metavar="METRIC", help=text, autocompletion=completion.metrics, **shown)


def _known_formats(formats: list[str]) -> list[str]:
    """Return the formats as given. Raises InputError for one that figures are not written in."""
    from ssmail.plots.provenance import FORMATS

    for name in formats:
        if name not in FORMATS:
            raise unknown_name("figure format", name, FORMATS)
    return formats


def _known_device(device: str) -> str:
    """Return the name as given. Raises InputError for an unknown device."""
    if not _DEVICE.fullmatch(device):
        meant = suggestion("cuda" if device.startswith("gpu") else device, DEVICES)
        raise InputError(f"--device takes {listed([*DEVICES, 'cuda:N'])}, not '{shortened(device, 60)}'; {meant}")
    return device


def known_statistic(stat: str | None) -> str | None:
    """Return the name as given. Raises InputError for an unknown statistic."""
    from ssmail.evaluation.statistics import Statistic

    if stat is not None and stat not in list(Statistic):
        raise unknown_name("statistic", stat, list(Statistic))
    return stat


def stat_option(default: str, what: str = "Centre and band") -> Any:
    """Return the option --stat. `what` it chooses, and what is chosen by `default`."""
    text = f"{what}: mean-std, median-iqr or mean-ci."
    return typer.Option("--stat", callback=known_statistic, help=text, show_default=default)


Database = Annotated[
    str,
    typer.Option("--db", envvar="SSMAIL_DB", metavar="PATH|URL", help="The database: a file, or an SQLAlchemy URL."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, with NaN and infinities as text.")]
Output = Annotated[
    Format | None,
    typer.Option("--format", help="How to print.", show_default="a table on a terminal, else CSV"),
]

# Which runs
RunIds = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="RUN",
        help="Ids or their first digits; all runs when none is given.",
        autocompletion=completion.run_ids,
    ),
]
RunId = Annotated[
    str,
    typer.Argument(metavar="RUN", help="The id of a run, or its first digits.", autocompletion=completion.run_ids),
]
Method = Annotated[str | None, method_option("Only runs of this method")]
Environment = Annotated[str | None, environment_option("Only runs on this environment")]
Profile = Annotated[str | None, _profile_option()]
FigureProfile = Annotated[str | None, _profile_option(show_default="the one that each figure draws")]
State = Annotated[
    str | None,
    typer.Option(
        "--state",
        metavar="STATE",
        help=f"Only runs in this state: {listed(STATES)}.",
        autocompletion=lambda: list(STATES),
    ),
]
FIGURE_NAMES = listed(f"{figure.name} ({figure.alias})" for figure in dict.fromkeys(FIGURES.values()))
Figure = Annotated[
    str | None,
    typer.Option(
        "--figure",
        metavar="FIGURE",
        help=f"Only runs that this figure of the paper needs: {FIGURE_NAMES}.",
        autocompletion=completion.figures,
    ),
]
Where = Annotated[
    list[str] | None,
    typer.Option(
        "--where",
        metavar="CONDITION",
        help="Only runs that meet this condition on a key of the spec, a metric or a column, such as sac.gamma=0.9, "
        "test/mode_mse<0.003 or seed!=0; repeatable, in quotes.",
        autocompletion=completion.settings,
    ),
]
Sort = Annotated[
    str | None,
    typer.Option(
        "--sort",
        metavar="[-]NAME",
        help="Order by this key, metric or column; -NAME is from high to low.",
        autocompletion=completion.columns,
    ),
]
Descending = Annotated[bool, typer.Option("--descending", help="With --sort, from high to low.")]

# Training
SEEDS_HELP = "Seeds, one run each: 0-4 for five of them, 0,2,5 or 0-2,7; a single number is one seed, not a count."
TrainingProfile = Annotated[
    str,
    typer.Option(
        "--profile",
        metavar="PROFILE",
        help="smoke (seconds), quick (minutes), standard (quick, with an exact ssail on yjunction), paper (the paper's "
        "scale: hours), or one of your experiments.yaml.",
        autocompletion=completion.profiles,
    ),
]
Seeds = Annotated[str, typer.Option("--seeds", metavar="SEEDS", help=SEEDS_HELP)]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Runs to compute at once, one process each.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the spec: sac.gamma=0.9; repeatable.",
        autocompletion=completion.settings,
    ),
]
ResumeOption = Annotated[
    Resume,
    typer.Option("--resume", help="Continue an unfinished run: if there is one, never, or fail without one."),
]
DeviceOption = Annotated[
    str,
    typer.Option(
        "--device",
        metavar="DEVICE",
        callback=_known_device,
        help="auto (the GPUs, if there are any), cpu, cuda (the GPUs), or cuda:1 for the second GPU.",
        autocompletion=lambda: list(DEVICES),
    ),
]
PerDevice = Annotated[
    int, typer.Option("--per-device", min=1, help="Processes that use a GPU at the same time; --jobs is for all.")
]
Enqueue = Annotated[
    bool, typer.Option("--enqueue", help="Put the runs into the queue of the database for `ssmail worker`, and end.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would run, and train nothing.")]

# Drawing
OutDir = Annotated[Path, typer.Option("--out", help="The folder for the figures and their CSV files.")]
Formats = Annotated[
    list[str],
    typer.Option("--format", callback=_known_formats, help="png, pdf or svg; repeatable.", show_default="png"),
]
Stat = Annotated[str | None, stat_option("mean-std")]
_WITH_STATISTIC = list(dict.fromkeys(figure.name for figure in FIGURES.values() if figure.has_statistic))
StatOfFigures = Annotated[
    str | None,
    stat_option(
        "median-iqr on logarithmic axes, else mean-std",
        f"Centre and band of {', '.join(_WITH_STATISTIC[:-1])} and {_WITH_STATISTIC[-1]}",
    ),
]


def database_words(db: str) -> tuple[str, ...]:
    """Return how a command line names the database; not at all where it is the default one."""
    return () if db == DEFAULT_DATABASE else ("--db", db)


def named(words: list[str] | None, option: str | None) -> list[str]:
    """Return the names that are given as arguments, and with commas between them as the value of an option."""
    return [*(words or ()), *([part.strip() for part in option.split(",")] if option is not None else ())]


def is_missing(database: str) -> bool:
    """Return whether this is the path of a file that does not exist; False for a URL."""
    if "://" in database:
        return False
    try:
        return not Path(database).expanduser().exists()
    except (OSError, RuntimeError, ValueError) as error:  # too long a name; nobody's home; a null byte
        reason = getattr(error, "strerror", None) or str(error).rstrip(".").lower()
        raise InputError(f"{shortened(database, 120)} is no path of a database ({reason}); give another --db") from None


def open_store(
    database: str,
    made_by: str = "ssmail train --method ssail --profile quick --seeds 0-4",
    mark_dead: bool = True,
    artifacts: str | None = None,
) -> "Store":
    """Open the store for reading, after marking runs whose process has died as interrupted, where possible.

    Raises InputError, which says what makes a database, when the file does not exist: reading must not create it.
    """
    from ssmail.store import Store

    if is_missing(database):
        raise InputError(f"there is no database {database}; `{made_by}` makes one, or name another with --db.")
    store = noting_damage(Store.open(database, artifacts=artifacts))
    if mark_dead and not all(store.is_alive(row) for row in store.runs(state="running")):
        with suppress(SsmailError):
            store.mark_stale()
    return store


def noting_damage(store: "Store") -> "Store":
    """Return the store; when the command ends, note how many damaged rows it has left out."""

    def remark() -> str | None:
        rows = counted(len(store.damaged), "damaged row")
        command = command_line("ssmail", "db", "check", "--db", store.where)
        return f"{rows} left out; `{command}` says what is wrong" if store.damaged else None

    note_at_end(remark)
    return store


def select_runs(
    store: "Store",
    ids: list[str] | None,
    method: str | None,
    environment: str | None,
    profile: str | None,
    state: str | None,
    figure: str | None,
    where: list[str] | None = None,
) -> "list[RunRow]":
    """Return the runs that meet every condition, newest last.

    Raises InputError for an unknown id, state or figure, and for a condition that is none.
    """
    from ssmail.plots.series import needed_by
    from ssmail.store import RunState
    from ssmail.store.conditions import Condition, matching

    conditions = [Condition.parse(text) for text in where or ()]
    if state is not None and state not in list(RunState):
        raise unknown_name("state", state, list(RunState))
    runs = store.runs(ids=ids or None, method=method, environment=environment, profile=profile, state=state)
    if figure is not None:
        needed = needed_by(FIGURES[figure].name if figure in FIGURES else figure)  # experiments.yaml knows no aliases
        runs = [run for run in runs if needed(run)]
    return matching(store, runs, conditions)


def parse_seeds(text: str) -> list[int]:
    """ "0-2,7" -> [0, 1, 2, 7], in the given order and each once. Raises InputError for anything else."""
    seeds: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            shown = shortened(text, 60)
            raise InputError(f"--seeds takes whole numbers and ranges such as 0-4 or 0,2,5, not '{shown}'.")
        if max(len(first), len(last)) > 10:  # digits of 2**31
            raise _too_many(text)
        low, high = int(first), int(last or first)
        if low > high:
            raise InputError(f"the range {part.strip()} in --seeds runs backwards; write {high}-{low}.")
        if high - low >= MOST_SEEDS or high >= 2**31:
            raise _too_many(text)
        seeds.update(dict.fromkeys(range(low, high + 1)))
        if len(seeds) > MOST_SEEDS:
            raise _too_many(text)
    return list(seeds)


def _too_many(text: str) -> InputError:
    shown = shortened(text, 60)
    return InputError(f"--seeds {shown} is more than {MOST_SEEDS} seeds or a seed above 2147483647; give less.")


def pick_device(choice: str) -> str:
    """Return "cpu", "cuda" or "cuda:1". Raises InputError for a GPU that there is not."""
    if choice == "cpu":
        return choice
    import torch

    number = int(choice.partition(":")[2] or 0)
    found = torch.cuda.device_count()
    if number < found:
        return "cuda" if choice == AUTO else choice
    if choice == AUTO:
        return "cpu"
    there = f"only {', '.join(f'cuda:{index}' for index in range(found))} found" if found else "none is found"
    raise InputError(f"--device {choice} needs a CUDA GPU, and {there}; use --device {'cuda:0' if found else 'cpu'}.")


def parse_statistic(stat: str | None) -> "Statistic | None":
    """Return the statistic of that name, which --stat has checked."""
    from ssmail.evaluation.statistics import Statistic

    return None if stat is None else Statistic(stat)
