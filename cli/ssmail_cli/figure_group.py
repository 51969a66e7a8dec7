"""The command line of `ssmail plot`, on which several figures may be named at once."""

import re
from collections.abc import Sequence
from typing import Any

from typer.core import TyperCommand, TyperGroup

from ssmail.errors import InputError, unknown_name
from ssmail.paper.results import FIGURES
from ssmail_cli.command_group import Commands

ALL = "all"
_RUN = re.compile("[0-9a-f]{4,32}")  # a run, or the beginning of its id


class FigureGroup(Commands):
    """A group whose command line may name several things to draw, with options before, between and after the names.

    `plot fig4 --out X fig5 --profile quick` is read as `plot --out X` followed by the lines `fig4 --profile quick` and
    `fig5 --profile quick`: the group has the options in common, and every command parses all the others, so click
    refuses one that the command does not have. Only an option in SHARED may be meant for some of the commands alone.
    A command with an argument, as `plot control modes`, takes all names that come after its own.
    """

    SHARED = frozenset({"--runs", "--profile", "--stat"})

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Split the line, and let click parse the options in common and, for a single command, its line."""
        names, given, words = self._split(args, ctx.resilient_parsing)
        common = {option for parameter in self.params for option in parameter.opts}
        own = {key: tokens for key, tokens in given.items() if key not in common}
        lines = ctx.meta["lines"] = [
            [name, *(words if self._takes_words(name) else ()), *self._options_of(name, names, own)] for name in names
        ]
        first = lines[0] if lines else [token for tokens in own.values() for token in tokens]
        return super().parse_args(ctx, [*(token for key in given if key in common for token in given[key]), *first])

    def invoke(self, ctx: Any) -> None:
        """Parse the line of every command, then run the commands."""
        lines = ctx.meta["lines"]
        if not lines:
            raise InputError("name what to draw, such as fig4 or all; `ssmail plot --help` lists what there is.")
        for name, *_ in lines:
            if name not in self.commands:
                if _RUN.fullmatch(name):
                    raise InputError(f"{name} is no figure; name a run with --run, or those of a figure with --runs.")
                raise unknown_name("figure", name, [*FIGURES, *self.commands])
        if len(lines) > 1 and any(name == ALL for name, *_ in lines):
            raise InputError(f"{ALL} is every figure already; give it alone.")
        super(TyperGroup, self).invoke(ctx)  # the callback of the group
        contexts = [self.commands[name].make_context(name, line, parent=ctx) for name, *line in lines]
        for context in contexts:
            with context:
                context.command.invoke(context)

    def _takes_words(self, name: str) -> bool:
        command = self.commands.get(name)
        return command is not None and any(parameter.param_type_name == "argument" for parameter in command.params)

    def _split(self, args: Sequence[str], completing: bool) -> tuple[list[str], dict[str, list[str]], list[str]]:
        """Return the names, without aliases and repetitions, the tokens of each option by its key, as --out, and the
        words after the name of a command that takes them.

        Raises InputError for an option without its value, except when the shell is completing the line.
        """
        parameters = [*self.params, *(parameter for command in self.commands.values() for parameter in command.params)]
        is_flag = {key: getattr(parameter, "is_flag", False) for parameter in parameters for key in parameter.opts}
        is_flag |= {"-h": True, "--help": True}
        names: dict[str, None] = {}
        words: list[str] = []
        given: dict[str, list[str]] = {}
        tokens = iter(args)
        for token in tokens:
            if not token.startswith("-"):
                if names and self._takes_words(next(reversed(names))):
                    words.append(token)
                    continue
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
        return list(names), given, words

    def _options_of(self, name: str, names: Sequence[str], given: dict[str, list[str]]) -> list[str]:
        """Return the tokens for one of the commands: all but SHARED options that only others of them have."""
        options = {
            other: {key for parameter in self.commands[other].params for key in parameter.opts}
            for other in names
            if other in self.commands
        }
        for_others = self.SHARED & set().union(*options.values()) - options.get(name, set())
        return [token for key, tokens in given.items() if key not in for_others for token in tokens]


class FigureCommand(TyperCommand):
    """The command of a figure of the paper, without the options that the figure does not have.

    What does not go together is refused while the options are parsed, before anything is drawn.
    """

    def __init__(self, name: str, *, params: list[Any], **settings: Any) -> None:
        module = FIGURES[name]
        lacks = {"environment": not module.has_environment, "stat": not module.has_statistic}
        kept = [item for item in params if not lacks.get(item.name)]
        for item in kept:
            if item.name == "stat":
                item.show_default = module.statistic
        super().__init__(name, params=kept, **settings)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options. Raises InputError for two choices of runs."""
        rest = super().parse_args(ctx, args)
        if ctx.params["runs"] and ctx.params["profile"]:
            raise InputError("--runs names the runs already; leave --profile out.")
        return rest
