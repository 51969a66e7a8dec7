"""How groups of commands parse a line and print their help."""

import sys
from typing import Any

from typer.core import TyperGroup

from ssmail_cli.guesses import unknown_command


class Commands(TyperGroup):
    """A group of commands that answers a wrong word with the right one, and whose help cuts no summary."""

    ALONE: str | None = None
    """The command that is meant when the line names none."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command ALONE before options, or instead of nothing."""
        names_none = not args or (args[0].startswith("-") and args[0] not in ctx.help_option_names)
        if self.ALONE and names_none and not ctx.resilient_parsing:
            args = [self.ALONE, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the line names. Raises InputError with the nearest one for a wrong word."""
        if args[0] not in self.commands and not args[0].startswith("-") and not ctx.resilient_parsing:
            raise unknown_command(ctx, args[0])
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with the whole first sentence of its help."""
        rows = [(name, command.get_short_help_str(sys.maxsize)) for name, command in self.commands.items()]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
