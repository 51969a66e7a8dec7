"""`ssmail db`: inspect, upgrade, check, back up, merge and export the database."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import ExitCode, InputError, stored_values
from ssmail.plots.formatting import counted
from ssmail_cli import options
from ssmail_cli.artifacts import Artifacts, ArtifactsGiven
from ssmail_cli.command_group import Commands
from ssmail_cli.output import Format, chosen_format, note, print_rows, print_table, say, write_json

if TYPE_CHECKING:
    from ssmail.paper.reads import Contents
    from ssmail.store.maintenance.compact import Compact
    from ssmail.store.maintenance.merge import Merge
    from ssmail.store.maintenance.run_rows import Difference
    from ssmail.store.maintenance.whole_databases import DatabaseInformation


class DatabaseGroup(Commands):
    """`ssmail db` alone shows what the database holds."""

    ALONE = "info"


app = typer.Typer(
    cls=DatabaseGroup,
    help="Inspect, check, back up, merge and export a database; `ssmail db` alone shows what it holds.",
    rich_markup_mode=None,
)

COUNT_COLUMNS = {"environment": "env", "method": "method", "profile": "profile", "state": "state", "runs": "runs"}
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def info(as_json: Json = False, db: options.Database = options.DEFAULT_DATABASE) -> None:
    """Show what the database holds.

    Prints the revision of its schema, its size, the share of the arrays, and the number of runs by environment, method,
    profile and state. Does not upgrade it.
    """
    from ssmail.store.maintenance.whole_databases import describe_contents

    found = describe_contents(db)
    kind = chosen_format(as_json, None)
    rows = [asdict(count) for count in found.runs]
    if kind is Format.JSON:
        write_json({**asdict(found), "array_share": found.array_share, "runs": rows}, None)
    elif kind is Format.CSV:
        note(*_summary(found))
        print_rows(rows, COUNT_COLUMNS, kind)
    else:
        say(*_summary(found))
        print_table(rows, COUNT_COLUMNS)


@app.command()
def upgrade(as_json: Json = False, db: options.Database = options.DEFAULT_DATABASE) -> None:
    """Bring the tables to the newest schema.

    First writes a backup: of a file beside it, of a server's database into results/. All other commands also upgrade an
    older database when they open it, but without a backup.
    """
    from ssmail.store.maintenance.whole_databases import upgrade as upgrade_database

    done = upgrade_database(db)
    if as_json:
        write_json(asdict(done), None)
    elif done.before == done.after:
        say(f"{done.path} already has the newest schema, {done.after}")
    else:
        kept = f"; the old state is in {done.backup}" if done.backup else ""
        say(f"{done.path}: from schema {done.before or 'none'} to {done.after}{kept}")


@app.command()
def check(
    as_json: Json = False,
    artifacts: ArtifactsGiven = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Look for problems in the database and its checkpoints.

    Prints one line for each problem, with its remedy, and changes nothing. Reads the whole file and all checkpoints;
    safe while runs are being computed. Exit code 1: there are problems.
    """
    from ssmail.store.maintenance.checks import check as check_database

    problems = check_database(db, artifacts)
    if as_json:
        write_json([asdict(problem) for problem in problems], None)
    for problem in problems if not as_json else ():
        say(f"{problem.check}: {problem.problem}; {problem.remedy}")
    note(f"{db}: {counted(len(problems), 'problem')}" if problems else f"{db}: no problem found")
    if problems:
        raise typer.Exit(ExitCode.FAILURE)


@app.command()
def backup(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to write; it must not exist.")],
    as_json: Json = False,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Copy the database to a new file.

    That of a server is written by pg_dump, for pg_restore. Safe while runs are being computed. Checkpoints, which are
    separate files, are not copied.
    """
    from ssmail.store.maintenance.whole_databases import back_up

    size = back_up(db, file)
    if as_json:
        write_json({"path": file, "size_bytes": size}, None)
    else:
        say(f"wrote {file}, {_size(size)}")


@app.command()
def merge(
    other: Annotated[
        str,
        typer.Argument(metavar="OTHER.db", help="The file or URL of the database to take runs from; it is only read."),
    ],
    as_json: Json = False,
    artifacts: Artifacts = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Add the runs of another database to this one.

    Copies their checkpoints too. Of two runs with the same spec, seed and data, keeps the one that got further; of two
    that ended, keeps the one already there and reports differences. Runs that are being computed, and runs with damaged
    rows, are left out. A merge that fails or is killed changes nothing.
    """
    from ssmail.store.maintenance.merge import merge as merge_databases

    done = merge_databases(db, other, artifacts)
    if as_json:
        runs = [{"run": item.run.id, "fate": item.fate.value, "replaces": item.replaces} for item in done.runs]
        differences = [asdict(difference) for difference in done.differences]
        names = {"target": done.target, "other": done.other}
        without = done.without_checkpoints
        damaged = [{"run": problem.subject, "problem": problem.problem} for problem in done.damaged]
        lists = {"runs": runs, "differences": differences, "without_checkpoints": without, "damaged": damaged}
        write_json({**names, **lists}, None)
        return
    for problem in done.damaged:
        say(f"left out: {problem.problem}")
    for difference in done.differences:
        say(_difference(difference))
    say(f"merged {done.other} into {done.target}: {_fates(done)}")
    if done.without_checkpoints:
        note(f"{counted(len(done.without_checkpoints), 'run')} came without all checkpoints: {other} lacks them")


@app.command()
def export(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to write; it must not exist.")],
    compact: Annotated[
        bool, typer.Option("--compact", help="Only what figures and claims need; `ssmail db backup` copies everything.")
    ] = False,
    method: options.Method = None,
    environment: options.Environment = None,
    profile: options.Profile = None,
    figure: options.Figure = None,
    as_json: Json = False,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Write a small database that draws all figures and judges all claims.

    Keeps the newest finished or diverged run of each spec and seed, with the last value of every metric and the curves
    and arrays that figures and claims read, but no checkpoints. Reports what is left out.
    """
    from ssmail.paper.reads import contents
    from ssmail.store import Store
    from ssmail.store.maintenance.compact import export_compact, settled_cells
    from ssmail.store.maintenance.whole_databases import existing, require_current

    if not compact:
        raise InputError(
            "give --compact to export what figures and claims need; `ssmail db backup FILE` copies everything."
        )
    require_current(existing(db))
    store = options.noting_damage(Store.open(db))
    matching = options.select_runs(store, None, method, environment, profile, None, figure)
    runs = settled_cells(matching)
    if not runs:
        raise InputError(f"no finished or diverged run in {db} meets these conditions; `ssmail runs list` shows all.")
    needed = contents(store, runs)
    with stored_values("these runs"):
        done = export_compact(db, file, runs, needed.wanted)
    others = len(store.runs()) - len(runs)
    if as_json:
        write_json(
            {**asdict(done), "damaged": len(done.damaged), "left_out_runs": others, "undrawable": needed.undrawable},
            None,
        )
    else:
        _print_export(done, needed, others)


def _summary(found: "DatabaseInformation") -> list[str]:
    revision = found.revision or "none"
    if found.revision != found.newest_revision:
        revision += f" ({found.newest_revision} is the newest; `ssmail db upgrade`)"
    free = "" if found.free_bytes is None else f" ({_size(found.free_bytes)} of it free)"
    runs = counted(sum(count.runs for count in found.runs), "run")
    return [
        f"{found.path}: schema {revision}, {_size(found.size_bytes)}{free}, {runs}",
        f"{counted(found.metrics, 'value')} of metrics; {counted(found.arrays, 'array')}, {_size(found.array_bytes)} "
        f"({100 * found.array_share:.0f} % of the size); {counted(found.artifacts, 'checkpoint file')}",
    ]


def _fates(done: "Merge") -> str:
    """Return what happened to the runs: "3 runs added, 2 runs there already"."""
    from ssmail.store.maintenance.merge import Fate

    words = {
        Fate.ADDED: "added",
        Fate.REPLACED: "replaced runs that had got less far",
        Fate.ALREADY_THERE: "there already",
        Fate.BEHIND: "left out: less far than the run already there",
        Fate.BUSY: "left out: being computed",
        Fate.DIFFERENT: "left out: different from the run already there",
    }
    counts = [f"{counted(done.count(fate), 'run')} {text}" for fate, text in words.items() if done.count(fate)]
    if done.damaged:
        counts.append(f"{counted(len(done.damaged), 'run')} left out: damaged")
    return ", ".join(counts) or "no runs in it"


def _difference(found: "Difference") -> str:
    where = f" at epoch {found.step}" if found.step is not None else ""
    kept, left_out = ("absent" if value is None else value for value in (found.kept_value, found.left_out_value))
    return (
        f"nondeterminism: {found.method} on {found.environment}, spec {found.spec_hash[:8]}, seed {found.seed}: "
        f"{found.metric}{where} is {kept} in run {found.kept[:8]}, which is kept, and {left_out} in run "
        f"{found.left_out[:8]}, which is left out"
    )


def _print_export(done: "Compact", needed: "Contents", others: int) -> None:
    """Print the file on stdout, and what is not in it on stderr."""
    say(f"wrote {done.path}, {_size(done.size_bytes)}: {counted(done.runs, 'run')}")
    note(
        f"left out: {counted(others, 'other run')}; {counted(done.left_out_artifacts, 'checkpoint file')}; "
        f"{counted(done.left_out_metrics, 'value')} of metrics (kept: every last one, and the curves of "
        f"{', '.join(sorted(needed.wanted.curves))}); {counted(done.left_out_arrays, 'array')} (kept: {done.arrays}, "
        f"of {done.thinned} of them the part that is drawn)"
    )
    if done.damaged:
        note(f"left out: {counted(len(done.damaged), 'damaged row')}; `ssmail db check` names the runs")
    for figure, reason in needed.undrawable.items():
        note(f"{figure} cannot be drawn from it ({reason.removesuffix('.')})")


def _size(size: int) -> str:
    """Return a number of bytes as "12 kB" or "8.9 MB"."""
    return f"{size / 1e3:.0f} kB" if size < 1e6 else f"{size / 1e6:.1f} MB"
