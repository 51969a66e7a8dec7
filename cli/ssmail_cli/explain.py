"""`ssmail explain`: the runs behind a saved figure, and whether the database still agrees with it."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import ExitCode, shortened
from ssmail.plots.formatting import short_code
from ssmail_cli import options
from ssmail_cli.output import Format, chosen_format, note, print_rows, say, short, write_json

if TYPE_CHECKING:
    from ssmail.paper.explanation import Agreement, Explanation

NAMED = 3  # runs that a sentence names; the table has all
LONGEST_CAPTION = 1000  # characters
COLUMNS = {name: name for name in ("curve", "run", "seed", "state", "spec", "differs", "data", "code", "database")}


def explain(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A figure that ssmail saved (PNG, PDF, SVG), or the CSV beside it.")
    ],
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Show which runs a saved figure is drawn from.

    Lists the runs behind each curve, with spec (and how the specs of a method differ), data and code of each. Also
    collects the figure from the database again, and reports whether the runs and the values are still the same, numbers
    to within a millionth. Exit code 1: they are not; 0: they are, or there is nothing to compare with.
    """
    from ssmail.paper.explanation import compare
    from ssmail.paper.explanation import explain as explain_figure

    found = explain_figure(file)
    agreement = None if options.is_missing(db) else compare(found, options.open_store(db))
    kind = chosen_format(as_json, form)
    if kind is Format.JSON:
        write_json(_as_json(found, agreement), None)
    else:
        tell = say if kind is Format.TABLE else note
        tell(*_heading(found), _verdict(agreement, db))
        if rows := _rows(found, agreement):
            print_rows(rows, COLUMNS, kind)
    if agreement is not None and agreement.agrees is False:
        raise typer.Exit(ExitCode.FAILURE)


def _heading(found: "Explanation") -> list[str]:
    source = found.provenance
    about = "".join(f", {name} {short(value)}" for name, value in source.options.items())
    lines = [f"{found.path}: {source.figure}{about}; drawn with ssmail {source.drawn_with}"]
    lines += [shortened(source.caption, LONGEST_CAPTION)] if source.caption else []
    lines += [f"code of the runs: {', '.join(source.code)}"] if source.code else []
    lines += [f"data: {', '.join(source.dataset_hashes)}"] if source.dataset_hashes else []
    states = {"as written": "as it was written with the figure", "altered": "altered since", "missing": "missing"}
    lines += [f"CSV: {found.csv.name} is {states[found.csv_state]}"] if found.csv_state else []
    return lines


def _verdict(agreement: "Agreement | None", db: str) -> str:
    if agreement is None:
        return f"there is no database {db} to compare with; name one with --db"
    missing = [run[:8] for run, state in agreement.runs.items() if state == "missing"]
    changed = [f"{run[:8]} ({state})" for run, state in agreement.runs.items() if state not in ("same", "missing")]
    parts = [
        f"{len(runs)} of {len(agreement.runs)} runs {what}: {', '.join(runs[:NAMED])}{', ...' * (len(runs) > NAMED)}"
        for runs, what in ((missing, "missing"), (changed, "changed"))
        if runs
    ]
    if agreement.agrees:
        nearly = f", {agreement.reason}" if agreement.reason else ""
        return f"{agreement.where} agrees: it holds all runs, with the same values{nearly}"
    if agreement.values == "different":
        parts.append(f"the values differ: {agreement.reason}")
    if agreement.agrees is False:
        return f"{agreement.where} does not agree: {'; '.join(parts)}"
    return f"{agreement.where} cannot tell: {agreement.reason}"


def _rows(found: "Explanation", agreement: "Agreement | None") -> list[dict[str, Any]]:
    """Return a row for each run, with short ids and hashes."""
    source = found.provenance
    states = agreement.runs if agreement is not None else {}
    rows: list[dict[str, Any]] = [
        {
            "curve": run.curve,
            "run": run.id[:8],
            "method": run.method,
            "environment": run.environment,
            "profile": run.profile,
            "seed": run.seed,
            "state": run.state,
            "spec": run.spec_hash[:8],
            "differs": ", ".join(
                f"{key.rpartition('.')[2]} {short(value)}"
                for key, value in source.differs.get(run.spec_hash, {}).items()
            ),
            "data": (run.dataset_hash or "")[:8],
            "code": short_code(run.code),
            "database": states.get(run.id),
        }
        for run in source.runs
    ]
    return rows or [{"run": run_id[:8], "database": states.get(run_id)} for run_id in source.run_ids]


def _as_json(found: "Explanation", agreement: "Agreement | None") -> dict[str, Any]:
    csv = {"path": found.csv, "state": found.csv_state}
    database = None if agreement is None else {**asdict(agreement), "agrees": agreement.agrees}
    return {"path": found.path, **asdict(found.provenance), "csv": csv, "database": database}
