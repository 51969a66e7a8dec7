"""`ssmail runs`: list, show, compare, export and delete what the store holds."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import ExitCode, InputError, unknown_name
from ssmail.plots.formatting import counted
from ssmail_cli import comparison_tables, completion, options
from ssmail_cli.artifacts import ArtifactsGiven
from ssmail_cli.command_group import Commands
from ssmail_cli.output import (
    Format,
    chosen_format,
    confirm,
    note,
    print_rows,
    print_table,
    write_csv,
    write_json,
)
from ssmail_cli.run_table import ENVIRONMENT_METRICS, environment_metrics, rows_with_metrics, run_row

if TYPE_CHECKING:
    from pandas import DataFrame

    from ssmail.store import RunRow, Store


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
    "settings": "profile",
    "seed": "seed",
    "spec": "spec",
    "started": "start (UTC)",
}
SPARE = ("spec", "started")  # what a narrow terminal leaves out first
EXPORT_COLUMNS = ("run_id", "method", "environment", "profile", "seed", "state", "spec_hash", "name", "step", "value")


def _limit_option(what: str) -> Any:
    return typer.Option("--limit", min=1, help=f"Only so many {what}: the newest, or with --sort the first.")


@app.command("list")
def list_runs(
    ids: options.RunIds = None,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    state: options.State = None,
    figure: options.Figure = None,
    where: options.Where = None,
    sort: options.Sort = None,
    descending: options.Descending = False,
    limit: Annotated[int | None, _limit_option("runs")] = None,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """List runs with their test error, the newest last.

    What --where and --sort name has a column too. CSV and JSON have every column.
    """
    from ssmail.store.conditions import in_order

    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure, where)
    if not runs:
        note(f"no run in {store.where} meets these conditions")
    name, descending = _order(sort, descending)
    if name is not None:
        runs = in_order(store, runs, name, descending)
    runs = _limited(runs, limit, first=name is not None)
    errors = list(dict.fromkeys(environment_metrics(run.environment).error for run in runs))
    rows = rows_with_metrics(store, runs, errors)
    extra = _add_named(store, runs, rows, where, name)
    kind = chosen_format(as_json, form)
    if kind in (Format.CSV, Format.JSON):
        print_rows(rows, {**RUN_COLUMNS, **dict.fromkeys(errors, "")}, kind)
        return
    for row in rows:
        row |= {"spec": row["spec_hash"][:8], "error": row[environment_metrics(row["environment"]).error]}
    heading = errors[0].rpartition("/")[2] if len(errors) == 1 else "test\nerror"
    columns = {**RUN_COLUMNS, **{key: _heading(key) for key in extra if key not in errors}, "error": heading}
    if kind is Format.TABLE:
        print_table(rows, columns, spare=SPARE)
    else:
        print_rows(rows, columns, kind)


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
        options.metric_option(
            "Compare",
            show_default="; ".join(
                f"{', '.join(shown.compared)} of {name}" for name, shown in ENVIRONMENT_METRICS.items()
            ),
        ),
    ] = None,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    state: options.State = None,
    figure: options.Figure = None,
    where: options.Where = None,
    sort: options.Sort = None,
    descending: options.Descending = False,
    limit: Annotated[int | None, _limit_option("specs")] = None,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Compare specs over their seeds.

    Groups the runs that differ only in the seed, and shows mean, standard deviation (n - 1), median and the value of
    each seed's newest run; for a run without the metric, its state. test/on_path, test/path_rms and test/turn_* of runs
    stored before there were such metrics are computed from the rollouts stored of them. --sort by a metric takes the
    mean of each spec. As latex or markdown, prints a table of the specs with mean and standard deviation.

    Errors on different data cannot be compared, so each data set has tables of its own; those of your own trajectories
    have rows for constant velocity and for copies of the last state.
    """
    from ssmail.store.conditions import specs_in_order

    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure, where)
    if not runs:
        note(f"no run in {store.where} meets these conditions")
    name, descending = _order(sort, descending)
    if name is not None:
        runs = specs_in_order(store, runs, name, descending)
    specs = _limited(list(dict.fromkeys(run.spec_hash for run in runs)), limit, first=name is not None)
    runs = [run for run in runs if run.spec_hash in specs]
    kind = chosen_format(as_json, form)
    found = comparison_tables.compared(store, runs, metrics, beside=kind not in (Format.CSV, Format.JSON))
    for metric in metrics or ():
        if runs and not any(item.known for item in found if item.metric == metric):
            raise InputError(
                f"no run compared here has a metric '{metric}'; `ssmail runs show RUN` lists those it has."
            )
    note(*dict.fromkeys(item.computed for item in found if item.computed))
    if kind is Format.TABLE:
        comparison_tables.print_comparisons(found, metrics)
        return
    if kind.of_document:
        comparison_tables.print_overviews(found, metrics, kind)
        return
    seeds = sorted({seed for item in found for seed in item.values})
    print_rows([comparison_tables.comparison_row(item, seeds, kind) for item in found], {}, kind)


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
    where: options.Where = None,
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
        _export_to(to, out, options.open_store(db), (ids, method, environment, profile, state, figure, where))
        return
    if form is Format.TABLE or form.of_document:
        raise InputError("an export is csv or json, not a table; `ssmail runs list` prints tables.")
    store = options.open_store(db)
    runs = options.select_runs(store, ids, method, environment, profile, state, figure, where)
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
    artifacts: ArtifactsGiven = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Delete runs and their checkpoints.

    Refuses to delete a run that is being computed. A copy of the run in another database has the same checkpoints in
    --artifacts, and loses them.
    """
    import sys

    store = options.open_store(db, artifacts=artifacts)
    full = store.full_ids(ids)
    left = store.storage is None and any(item.by_content for run_id in full for item in store.artifacts(run_id))
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
    if left:
        note("their checkpoints stay where --artifacts put them, unless --artifacts is given here too")


def _order(sort: str | None, descending: bool) -> tuple[str | None, bool]:
    """Return the name to sort by and whether from high to low, which a hyphen before the name says too."""
    if sort is None and descending:
        raise InputError("--descending is for --sort; name what to sort by, such as --sort test/mode_mse.")
    return (sort[1:], True) if sort is not None and sort.startswith("-") else (sort, descending)


def _limited(items: list[Any], limit: int | None, first: bool) -> list[Any]:
    """Return so many of the items, the first or the last ones; all of them without a limit."""
    if limit is None:
        return items
    return items[:limit] if first else items[-limit:]


def _add_named(
    store: "Store", runs: "Sequence[RunRow]", rows: list[dict[str, Any]], where: list[str] | None, sort: str | None
) -> list[str]:
    """Add to the rows what conditions and order name and they lack, and return these names."""
    from ssmail.config.experiments import display_value
    from ssmail.store.conditions import COLUMNS, Condition, values_of

    names = dict.fromkeys([*(Condition.parse(text).name for text in where or ()), *([sort] if sort else [])])
    named = [name for name in names if name not in COLUMNS]
    for name in named:
        values = values_of(store, runs, name)
        for row in rows:
            row[name] = display_value(values.get(row["id"]))
    return named


def _heading(name: str) -> str:
    """Return a key or metric as a heading: gamma, test/ above mode_mse."""
    return name.replace("/", "/\n") if "/" in name else name.rpartition(".")[2]


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
    from ssmail.store.artifact_storage import place_of

    return {
        "run": run_row(run),
        "spec": run.spec,
        "metrics": _values(store.latest_metrics([run.id])),
        "arrays": store.array_names(run.id),
        "artifacts": [
            {
                "name": item.name,
                "path": place_of(item, store.storage),
                "sha256": item.sha256,
                "size_bytes": item.size_bytes,
            }
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
