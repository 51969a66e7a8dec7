"""The command that was meant by a word or an option that ssmail does not have.

Someone who knows other tools tries their words: `ssmail list`, `--lr`, `--gpu`. The tables say what does the same here;
what is in none of them is compared with all commands, all options and all keys of the spec.
"""

import difflib
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from ssmail.config.names import METHODS, flatten
from ssmail.errors import InputError, shortened
from ssmail.paper.results import FIGURES
from ssmail.plots.formatting import listed
from ssmail_cli.completion import ablations

WORDS = {
    **dict.fromkeys(("ls", "log", "logs", "status", "history", "ps"), "runs list"),
    **dict.fromkeys(("evaluate", "eval", "test", "score", "metrics", "results", "leaderboard"), "runs compare"),
    **dict.fromkeys(("rm", "remove", "del"), "runs delete"),
    **dict.fromkeys(("view", "inspect", "describe", "spec"), "runs show"),
    **dict.fromkeys(("tensorboard", "mlflow", "csv"), "runs export"),
    **dict.fromkeys(("run", "fit", "learn", "start", "resume", "continue", "method", "methods", *METHODS), "train"),
    **dict.fromkeys(("sweep", "grid", "tune", "search", "hparams", "ablation", "ablations"), "ablate"),
    **dict.fromkeys(("draw", "figure", "figures", "fig", "show-figure", "visualize", "curves"), "plot"),
    **dict.fromkeys(("gif", "animate", "video", "render"), "plot film"),
    **dict.fromkeys(("predict", "sample", "infer", "inference", "rollout"), "forecast"),
    **dict.fromkeys(("onnx", "save", "model"), "export-model"),
    **dict.fromkeys(("import", "load", "convert"), "import-data"),
    **dict.fromkeys(("generate", "data", "dataset", "make-data"), "generate-yjunction"),
    **dict.fromkeys(("download", "mocap", "cmu"), "prep-mocap"),
    **dict.fromkeys(("judge", "verify", "verdicts", "claim"), "claims"),
    **dict.fromkeys(("paper", "replicate"), "reproduce"),
    **dict.fromkeys(("html", "summary", "summarize"), "report"),
    **dict.fromkeys(("why", "provenance", "trace"), "explain"),
    **dict.fromkeys(("database", "migrate", "vacuum"), "db"),
    **dict.fromkeys(("version", "about"), "--version"),
    **dict.fromkeys(("man", "usage", "docs"), "help"),
    **dict.fromkeys(("env", "envs", "environments", "profiles"), "train --help"),
}
"""Words of other tools, and what does the same in ssmail."""

OPTIONS = {
    **dict.fromkeys(("--gpu", "--gpus", "--cuda"), "--device cuda"),
    "--cpu": "--device cpu",
    **dict.fromkeys(("--seed", "--num-seeds", "--n-seeds", "-s"), "--seeds 0-4"),
    **dict.fromkeys(("--workers", "--num-workers", "--processes", "--parallel", "--threads", "-n"), "--jobs"),
    **dict.fromkeys(("--algo", "--algorithm", "--model", "--agent", "-m"), "--method"),
    **dict.fromkeys(("--environment", "--task", "--env-id", "-e"), "--env"),
    **dict.fromkeys(("--database", "--store", "--storage"), "--db"),
    **dict.fromkeys(("--output", "--output-dir", "--out-dir", "--outdir", "--dir", "--save", "-o"), "--out"),
    **dict.fromkeys(("--overwrite", "--yes-overwrite", "-f"), "--force"),
    **dict.fromkeys(("--restart", "--no-resume", "--fresh"), "--resume never"),
    **dict.fromkeys(("--plan", "--noop", "--simulate"), "--dry-run"),
    **dict.fromkeys(("--size", "--preset", "--scale"), "--profile"),
    **dict.fromkeys(("--figures", "--fig", "--figure"), "--only"),
    **dict.fromkeys(("--data", "--dataset", "--file", "--path"), "--set data.path=FILE"),
    **dict.fromkeys(("--id", "--run-id"), "--run"),
}
"""Options of other tools, and those of ssmail, for the commands that have them."""

KEYS = {
    **dict.fromkeys(("--lr", "--learning-rate", "--step-size"), "learning_rate"),
    **dict.fromkeys(("--n-epochs", "--num-epochs", "--max-epochs", "--iterations", "--iters"), "epochs"),
    **dict.fromkeys(("--batch-size", "--bs", "-b"), "batch"),
    **dict.fromkeys(("--discount",), "gamma"),
    **dict.fromkeys(("--tau",), "polyak"),
    **dict.fromkeys(("--hidden-size", "--hidden-dim", "--width", "--units"), "hidden"),
    **dict.fromkeys(("--entropy", "--alpha-entropy"), "target_entropy"),
    **dict.fromkeys(("--num-agents", "--n-agents"), "agents"),
    **dict.fromkeys(("--horizon", "--length"), "steps"),
    **dict.fromkeys(("--noise",), "input_noise"),
}
"""Options of other tools that are keys of the spec here, by the last part of the key."""

_MOST_KEYS = 5  # in a message


def unknown_command(ctx: Any, word: str) -> InputError:
    """An InputError for a word that is no command of this group, with the command that was meant."""
    root = ctx.find_root()
    leaves = _leaves(root.command)
    path, shown = ctx.command_path, shortened(word, 60)
    own = {name: f"{path} {name}" for name in ctx.command.commands}
    meant = _meant(word.lower(), own, leaves)
    hint = f"did you mean {' or '.join(f'`{command}`' for command in meant)}?" if meant else None
    return InputError(f"`{path}` has no command {shown}; {hint or f'`{path} --help` lists those it has.'}")


def _meant(word: str, own: dict[str, str], leaves: dict[str, list[str]]) -> Sequence[str]:
    """Return the commands that a word may stand for: by the same name elsewhere, by the tables, or by likeness."""
    if word in leaves or word in ablations():
        return [*leaves.get(word, ()), *([f"ssmail ablate {word}"] if word in ablations() else ())]
    if word in WORDS:
        target = WORDS[word]
        return [f"ssmail {target} {word}" if word in METHODS else f"ssmail {target}"]
    if close := difflib.get_close_matches(word, own, n=1):
        return [own[close[0]]]
    if close := difflib.get_close_matches(word, [*leaves, *WORDS], n=1):
        return leaves.get(close[0]) or [f"ssmail {WORDS[close[0]]}"]
    return []


def _leaves(group: Any, path: str = "ssmail") -> dict[str, list[str]]:
    """Return the lines of all commands by the last word, of a figure also by its alias."""
    found: dict[str, list[str]] = {}
    for name, command in group.commands.items():
        for key in (name, FIGURES[name].alias) if name in FIGURES else (name,):
            found.setdefault(key, []).append(f"{path} {name}")
        if hasattr(command, "commands"):
            for key, lines in _leaves(command, f"{path} {name}").items():
                found.setdefault(key, []).extend(lines)
    return found


def unknown_option(name: str, ctx: Any) -> str:
    """Return a sentence about an option that the command does not have, with what was meant."""
    command, group = ctx.command_path, ctx.parent
    params = [*ctx.command.params, *(group.command.params if group and group.parent else ())]  # plot has its --out
    meant = _option_meant(name, [option for parameter in params for option in parameter.opts])
    hint = f"did you mean {meant}?" if meant else f"`{command} --help` lists those it has."
    return f"`{command}` has no option {shortened(name, 60)}; {hint}"


def _option_meant(name: str, own: Sequence[str]) -> str | None:
    long = [option for option in own if option.startswith("--")]
    if name in OPTIONS and OPTIONS[name].split()[0] in own:
        return OPTIONS[name]
    defaults = _defaults() if "--set" in own else {}
    key = KEYS.get(name, name.lstrip("-").replace("-", "_"))
    if found := [each for each in defaults if each == key or f".{each}".endswith((f".{key}", f"_{key}"))]:
        return _settings(found, defaults)
    if close := difflib.get_close_matches(name, long, n=1):
        return close[0]
    by_last = {each.rpartition(".")[2]: each for each in defaults}
    if close := difflib.get_close_matches(key, by_last, n=1):
        return _settings([by_last[close[0]]], defaults)
    return None


def _settings(keys: Sequence[str], defaults: dict[str, Any]) -> str:
    """Return how --set gives one of these keys: "--set training.epochs=N"."""
    number = isinstance(defaults[keys[0]], int | float) and not isinstance(defaults[keys[0]], bool)
    value = "N" if number else "VALUE"
    if len(keys) == 1:
        return f"--set {keys[0]}={value}"
    return f"--set KEY={value} with the key {listed(keys[:_MOST_KEYS])}"


def _defaults() -> dict[str, Any]:
    """Return the keys of the spec with their defaults; none if experiments.yaml cannot be read."""
    from ssmail.config.experiments_file import load_experiments

    with suppress(InputError):
        return flatten(load_experiments().defaults)
    return {}
