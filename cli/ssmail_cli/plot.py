"""`ssmail plot`: figures of the paper, from the database alone."""

from pathlib import Path
from typing import Annotated

import typer

from ssmail_cli.display import note
from ssmail_cli.options import DEFAULT_DATABASE, Database, open_store


def plot(
    figures: Annotated[
        list[str],
        typer.Argument(metavar="FIGURE...", help="fig4 (stability), fig5 (modes), fig9 (yjunction)."),
    ],
    out: Annotated[Path, typer.Option("--out", help="The folder for the figures and their CSV files.")] = Path(
        "results/figures"
    ),
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", help="png, pdf or svg; give it again for more than one.", show_default="png"),
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--runs",
            metavar="RUN[,RUN...]",
            help="Draw these runs (ids or their first digits); repeatable.",
            show_default="the spec with the most seeds",
        ),
    ] = None,
    db: Database = DEFAULT_DATABASE,
) -> None:
    """Draw figures of the paper from stored runs.

    Each comes with a CSV of exactly what it shows, and the ids of the runs stand in the metadata of the files. Prints
    the paths of the files.
    """
    from ssmail.experiments import unknown_name
    from ssmail.figures import FIGURES, save
    from ssmail.figures.provenance import FORMATS

    for name in figures:
        if name not in FIGURES:
            raise unknown_name("figure", name, FIGURES)
    for form in formats or []:
        if form not in FORMATS:
            raise unknown_name("figure format", form, FORMATS)
    ids = [part for text in runs or [] for part in text.split(",") if part] or None
    store = open_store(db)
    for name in dict.fromkeys(FIGURES[name].name for name in figures):
        record = FIGURES[name].collect(store, ids)
        for remark in record.notes:
            note(f"{name}: {remark}")
        for path in save(name, record, FIGURES[name].draw(record), out, formats or ["png"]):
            typer.echo(path)
