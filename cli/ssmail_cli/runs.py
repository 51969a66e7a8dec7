"""`ssmail runs`: list, show, compare, export and delete what the store holds."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import ExitCode, InputError, printable, unknown_name
from ssmail.plots.formatting import counted
from ssmail_cli import completion, options
from ssmail_cli.command_group import Commands
from ssmail_cli.output import (
    Format,
    chosen_format,
    confirm,
    note,
    print_rows,
    print_table,
    say,
    short,
    write_csv,
    write_json,
)
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics, rows_with_metrics, run_row

if TYPE_CHECKING:
    from pandas import DataFrame

    from ssmail.store import RunRow, Store
    from ssmail.store.comparison import Comparison


class RunsGroup(Commands):
    """`ssmail runs` alone lists the runs."""

    ALONE = "list"


app = typer.Typer(
    cls=RunsGroup,
    help="List, show, compare, export and delete stored runs; `ssmail runs` alone lists them.",
    rich_markup_mode=None,
)

RUN_COLUMNS = {
    "run": "run",
    "state": "state",
    "method": "method",
    "environment": "env",
    "profile": "profile",
    "seed": "seed",
    "spec": "spec",
    "started": "start (UTC)",
}
EXPORT_COLUMNS = ("run_id", "method", "environment", "profile", "seed", "state", "spec_hash", "name", "step", "value")


@app.command("list")
def list_runs(
    ids: options.RunIds = None,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    state: options.State = None,
    figure: options.Figure = None,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """List runs with their test error, the newest last.

    CSV and JSON have every column.
    """
    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure)
    if not runs:
        note(f"no run in {store.where} meets these conditions")
    errors = list(dict.fromkeys(environment_metrics(run.environment).error for run in runs))
    rows = rows_with_metrics(store, runs, errors)
    kind = chosen_format(as_json, form)
    if kind is Format.TABLE:
        short_rows = [
            {**row, "spec": row["spec_hash"][:8], "error": row[environment_metrics(row["environment"]).error]}
            for row in rows
        ]
        heading = errors[0].rpartition("/")[2] if len(errors) == 1 else "test\nerror"
        print_table(short_rows, {**RUN_COLUMNS, "error": heading})
    else:
        print_rows(rows, {**RUN_COLUMNS, **dict.fromkeys(errors, "")}, kind)


@app.command()
def show(
    run: options.RunId,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Show everything about one run.

    Prints its columns, its spec, the last value of each metric, its arrays and its files.
    """
    store = options.open_store(db)
    (found,) = store.runs(ids=[run])
    kind = chosen_format(as_json, form)
    if kind is Format.JSON:
        write_json(_details(store, found), None)
        return
    columns = {"section": "", "name": "", "step": "step", "value": "value"}
    print_rows(list(_detail_rows(_details(store, found))), columns, kind)


@app.command()
def compare(
    ids: options.RunIds = None,
    metrics: Annotated[
        list[str] | None,
        typer.Option(
            "--metric",
            metavar="METRIC",
            help="Compare this metric, which `ssmail runs show RUN` lists; repeatable.",
            show_default="; ".join(
                f"{', '.join(shown.compared)} of {name}" for name, shown in ENVIRONMENT_METRICS.items()
            ),
            autocompletion=completion.metrics,
        ),
    ] = None,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    state: options.State = None,
    figure: options.Figure = None,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Compare specs over their seeds.

    Groups the runs that differ only in the seed, and shows mean, standard deviation (n - 1), median and the value of
    each seed's newest run; for a run without the metric, its state. test/on_path, test/path_rms and test/turn_* of runs
    stored before there were such metrics are computed from the rollouts stored of them.
    """
    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure)
    if not runs:
        note(f"no run in {store.where} meets these conditions")
    found = _compared(store, runs, metrics)
    for metric in metrics or ():
        if runs and not any(item.known for item in found if item.metric == metric):
            raise InputError(
                f"no run compared here has a metric '{metric}'; `ssmail runs show RUN` lists those it has."
            )
    note(*dict.fromkeys(item.computed for item in found if item.computed))
    kind = chosen_format(as_json, form)
    if kind is Format.TABLE:
        _print_comparisons(found)
        return
    seeds = sorted({seed for item in found for seed in item.values})
    print_rows([_comparison_row(item, seeds, kind) for item in found], {}, kind)


@app.command()
def export(
    ids: options.RunIds = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The file to write, replacing it; with --to the folder.", show_default="stdout"),
    ] = None,
    to: Annotated[
        str | None, typer.Option("--to", help="Write for tensorboard or mlflow, into the folder --out.")
    ] = None,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    state: options.State = None,
    figure: options.Figure = None,
    as_json: options.Json = False,
    form: Annotated[
        Format, typer.Option("--format", help="csv: one line per value; json: runs with specs and metrics.")
    ] = Format.CSV,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Export every metric of every epoch.

    With --to, writes the metrics and the spec of each run for `tensorboard --logdir DIR` or `mlflow ui
    --backend-store-uri DIR`.
    """
    if to is not None:
        _export_to(to, out, options.open_store(db), (ids, method, environment, profile, state, figure))
        return
    if form is Format.TABLE:
        raise InputError("an export is csv or json, not a table; `ssmail runs list` prints tables.")
    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure)
    if as_json or form is Format.JSON:
        write_json(
            [{**run_row(run), "spec": run.spec, "metrics": _values(store.metrics([run.id]))} for run in runs], out
        )
    else:
        rows = ({"run_id": run.id, **run_row(run), **item} for run in runs for item in _values(store.metrics([run.id])))
        write_csv(rows, EXPORT_COLUMNS, out)
    note(f"exported {counted(len(runs), 'run')}{f' to {out}' if out else ''}")


@app.command()
def delete(
    ids: Annotated[
        list[str],
        typer.Argument(metavar="RUN", help="Ids of runs, or their first digits.", autocompletion=completion.run_ids),
    ],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Delete without asking.")] = False,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Delete runs and their checkpoints.

    Refuses to delete a run that is being computed.
    """
    import sys

    store = options.open_store(db)
    full = store.full_ids(ids)
    known = {run.id: f"{run.method}, seed {run.seed}, {run.state}" for run in store.runs()}
    names = ", ".join(f"{run_id[:8]} ({known.get(run_id, 'damaged')})" for run_id in full)
    if not yes:
        if not sys.stdin.isatty():
            raise InputError(f"deleting needs a confirmation; give --yes to delete {names}.")
        if not confirm(f"Delete {names}?"):
            note("nothing deleted")
            raise typer.Exit(ExitCode.FAILURE)
    store.delete(full)
    note(f"deleted {names}")


def _export_to(tool: str, out: Path | None, store: "Store", selection: Any) -> None:
    from ssmail.store.tracking import TOOLS

    if tool not in TOOLS:
        raise unknown_name("tool", tool, TOOLS)
    if out is None:
        raise InputError(f"--to {tool} writes a folder; name it with --out.")
    runs = options.select_runs(store, *selection)
    TOOLS[tool](store, runs, out)
    note(f"exported {counted(len(runs), 'run')} to {out}")


def _values(metrics: "DataFrame") -> list[dict[Any, Any]]:
    """Return the recorded values of a run: name, step, value."""
    return metrics[["name", "step", "value"]].to_dict("records")


def _details(store: "Store", run: "RunRow") -> dict[str, Any]:
    return {
        "run": run_row(run),
        "spec": run.spec,
        "metrics": _values(store.latest_metrics([run.id])),
        "arrays": store.array_names(run.id),
        "artifacts": [
            {"name": item.name, "path": item.path, "sha256": item.sha256, "size_bytes": item.size_bytes}
            for item in store.artifacts(run.id)
        ],
    }


def _detail_rows(details: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the details as rows: section, name, step (of a metric), value."""
    from ssmail.config.names import flatten

    for section in ("run", "spec"):
        for name, value in flatten(details[section]).items():
            yield {"section": section, "name": name, "step": None, "value": value}
    for metric in details["metrics"]:
        yield {"section": "metric", **metric}
    for name in details["arrays"]:
        yield {"section": "array", "name": name, "step": None, "value": None}
    for item in details["artifacts"]:
        yield {"section": "artifact", "name": item["name"], "step": None, "value": item["path"]}


def _compared(store: "Store", runs: "Sequence[RunRow]", metrics: Sequence[str] | None) -> "list[Comparison]":
    """Compare the runs of each environment by the given metrics, or by those of the environment."""
    from ssmail.store.comparison import compare_runs

    return [
        item
        for environment in dict.fromkeys(run.environment for run in runs)
        for item in compare_runs(
            store,
            [run for run in runs if run.environment == environment],
            metrics or list(environment_metrics(environment).compared),
        )
    ]


def _headings(group: "list[Comparison]") -> dict[str, str]:
    names = {
        item.metric: printable(item.metric).replace("_constant_velocity", "\nconstant\nvelocity") for item in group
    }
    return {metric: name.replace("/", "/\n") for metric, name in names.items()}


def _print_comparisons(found: "list[Comparison]") -> None:
    """Print a table for each spec, with a row for each seed, mean, std and median and a column for each metric; then a
    table of the specs of each environment that has several.
    """
    specs = [list(metrics) for _, metrics in groupby(found, key=lambda item: item.spec_hash)]
    for group in specs:
        first = group[0]
        rows: list[dict[str, Any]] = [
            {"seed": str(seed) if state == "finished" else f"{seed} {state}"}
            | {item.metric: item.values[seed] for item in group}
            for seed, state in first.states.items()
        ]
        for name in ("mean", "std", "median"):
            rows.append({"seed": name, **{item.metric: getattr(item, name) for item in group}})
        differs = "".join(f", {key}={short(value)}" for key, value in first.differs.items())
        say(f"{first.method} on {first.environment}, profile {first.profile}, spec {first.spec_hash[:8]}{differs}")
        print_table(rows, {"seed": "seed", **_headings(group)})
        say("")
    between: tuple[str, ...] = ()
    for environment, groups in groupby(specs, key=lambda group: group[0].environment):
        alike = list(groups)
        if len(alike) > 1:
            say(*between, f"{environment}: mean ± standard deviation; seeds: with the first metric, of all")
            columns = {"spec": "spec", "seeds": "seeds", **_headings(alike[0])}
            print_table([_overview_row(group) for group in alike], columns)
            between = ("",)


def _overview_row(group: "list[Comparison]") -> dict[str, Any]:
    first = group[0]
    differs = ", ".join(f"{key.rpartition('.')[2]} {short(value)}" for key, value in first.differs.items())
    spec = f"{first.method} {differs or first.spec_hash[:8]}"
    seeds = f"{len(first.known)}/{len(first.values)}"
    return {"spec": spec, "seeds": seeds, **{item.metric: _mean_and_std(item) for item in group}}


def _mean_and_std(item: "Comparison") -> str | None:
    if item.mean is None:
        return None
    return f"{item.mean:.3g}" if item.std is None else f"{item.mean:.3g} ± {item.std:.2g}"


def _comparison_row(item: "Comparison", seeds: Sequence[int], kind: Format) -> dict[str, Any]:
    """Return one spec and metric as a row of CSV (with a column for each seed) or JSON."""
    each = {seed: item.states[seed].value if value is None else value for seed, value in item.values.items()}
    row = {
        "method": item.method,
        "environment": item.environment,
        "profile": item.profile,
        "spec_hash": item.spec_hash,
        "differs": dict(item.differs),
        "metric": item.metric,
        "runs": len(item.values),
        "values": len(item.known),
        "mean": item.mean,
        "std": item.std,
        "median": item.median,
    }
    if kind is Format.JSON:
        return {**row, "seeds": each}
    return {**row, **{f"seed_{seed}": each.get(seed) for seed in seeds}}
