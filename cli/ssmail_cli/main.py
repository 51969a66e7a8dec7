"""The Typer application: its commands, and how a failure ends (one line on stderr and an exit code)."""

import logging
import os
import re
import sys
from typing import Annotated, Any

import typer

from ssmail import __version__
from ssmail.errors import ExitCode, SsmailError, shortened
from ssmail_cli import (
    claims,
    completion,
    config,
    control,
    datasets,
    db,
    explain,
    forecast,
    import_data,
    plot,
    report,
    reproduce,
    runs,
    train,
    work_queue,
)
from ssmail_cli.command_group import Commands
from ssmail_cli.guesses import unknown_option
from ssmail_cli.output import (
    WIDEST,
    OutputError,
    complain,
    discard_stdout,
    error_line,
    guard_streams,
    note,
    print_remarks,
    say,
)

_LOG = logging.getLogger("ssmail")
_NO_TEXT = re.compile("[\0\ud800-\udfff]")  # a null, or a byte that is not UTF-8, as Python passes it on

app = typer.Typer(
    name="ssmail",
    cls=Commands,
    help="Run, store and redraw the experiments of SS-MAIL (Self-Supervised Multi-Agent Imitation Learning).",
    epilog="Exit codes: 0 done, 1 failure, 2 wrong usage or input, 3 some runs unfinished or missing, 130 interrupted.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": WIDEST},
)
app.command("generate-yjunction")(datasets.generate_yjunction)
app.command("generate-letters")(datasets.generate_letters)
app.command("prep-mocap")(datasets.prep_mocap)
app.command("import-data")(import_data.import_data)
app.command("train")(train.train)
app.command("ablate")(train.ablate)
app.command("ablate-alpha", cls=train.AblateAlias, help="Short for `ssmail ablate alpha`.")(train.ablate)
app.command("ablate-beta", cls=train.AblateAlias, help="Short for `ssmail ablate beta`.")(train.ablate)
app.command("control")(control.control)
app.command("reproduce")(reproduce.reproduce)
app.command("worker")(work_queue.worker)
app.command("queue")(work_queue.queue)
app.command("report")(report.report)
app.command("claims")(claims.claims)
app.command("explain")(explain.explain)
app.command("forecast")(forecast.forecast)
app.command("export-model")(forecast.export_model)
app.add_typer(plot.app, name="plot")
app.add_typer(runs.app, name="runs")
app.add_typer(db.app, name="db")
app.add_typer(config.app, name="config")


class _Notes(logging.Handler):
    """Prints what ssmail logs as notes on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


def _print_version(wanted: bool) -> None:
    if wanted:
        say(f"ssmail {__version__}")
        raise typer.Exit


def _names(ctx: typer.Context) -> list[str]:
    """Return the commands that the words before name, for the shell to complete."""
    group: Any = ctx.find_root().command
    for word in ctx.params.get("words") or ():
        group = getattr(group, "commands", {}).get(word)
    return list(getattr(group, "commands", {}))


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", "-v", "-V", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """The options of ssmail itself."""


@app.command("help")
def show_help(
    ctx: typer.Context,
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="COMMAND", help="A command: train, or plot fig4.", autocompletion=_names),
    ] = None,
) -> None:
    """Show the help of a command, as its --help does."""
    ctx.find_root().command.main([*(words or []), "--help"], prog_name="ssmail", standalone_mode=False)


def main() -> None:
    """The entry point `ssmail`."""
    guard_streams()
    code = run(sys.argv[1:])
    try:
        sys.stdout.flush()
    except (OSError, OutputError):
        discard_stdout()
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code; a failure prints one line, and a traceback with SSMAIL_DEBUG=1."""
    for argument in arguments:
        if _NO_TEXT.search(argument):  # neither a database nor a file format can hold it
            return _complain(f"the argument {shortened(argument, 60)} is not UTF-8 text; rename it", ExitCode.BAD_INPUT)
    if not _LOG.handlers:
        _LOG.addHandler(_Notes())
    os.environ["MPLBACKEND"] = "agg"  # figures are only saved, and another value may name any module
    try:
        try:
            if completion.ASKED in os.environ:
                completion.take_values_as_they_are()
            code = app(arguments or ["--help"], prog_name="ssmail", standalone_mode=False)
        finally:
            print_remarks()
        sys.stdout.flush()
    except SsmailError as error:
        if isinstance(error, OutputError):
            discard_stdout()
        return _complain(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # the reader of stdout, such as `head`, has seen enough
        discard_stdout()
        return ExitCode.FAILURE
    except Exception as error:
        if hasattr(error, "format_message"):  # what Typer, whatever its version, raises for a wrong command line
            return _complain(_usage(error), ExitCode.BAD_INPUT)
        if isinstance(error, OSError) and error.filename and not os.environ.get("SSMAIL_DEBUG"):
            return _complain(
                f"{error.filename} cannot be used: {error.strerror}; give another path", ExitCode.BAD_INPUT
            )
        return _complain(error_line(error), ExitCode.FAILURE)
    return code if isinstance(code, int) else ExitCode.OK


def _complain(sentence: str, code: int) -> int:
    complain(sentence)
    return code


def _usage(error: Any) -> str:
    """Return Typer's error as one sentence on one line."""
    if hasattr(error, "option_name") and hasattr(error, "possibilities"):  # an unknown option
        return unknown_option(error.option_name, error.ctx)
    sentence = " ".join(error.format_message().split())
    sentence = sentence.replace("Value error, ", "").replace(": Input should", ": it should")
    return sentence[:1].lower() + sentence[1:]
