"""Comparisons of specs over their seeds, as `ssmail runs compare` prints them."""

from collections.abc import Sequence
from itertools import chain, groupby
from typing import TYPE_CHECKING, Any

from ssmail.errors import printable
from ssmail_cli.output import Format, print_rows, print_table, say, short
from ssmail_cli.run_table import environment_metrics

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store
    from ssmail.store.comparison import Comparison


def compared(store: "Store", runs: "Sequence[RunRow]", metrics: Sequence[str] | None) -> "list[Comparison]":
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


def print_comparisons(found: "list[Comparison]") -> None:
    """Print a table for each spec, with a row for each seed, mean, std and median and a column for each metric; then a
    table of the specs of each environment that has several.
    """
    for group in chain.from_iterable(_by_environment(found)):
        first = group[0]
        rows: list[dict[str, Any]] = [
            {"seed": str(seed) if state == "finished" else f"{seed} {state}"}
            | {item.metric: item.values[seed] for item in group}
            for seed, state in first.states.items()
        ]
        for name in ("mean", "std", "median"):
            rows.append({"seed": name, **{item.metric: getattr(item, name) for item in group}})
        told = (f", {key}={short(value)}" for key, value in first.differs.items() if key not in first.changes)
        about = f"{first.method} on {first.environment}, profile {first.settings}, spec {first.spec_hash[:8]}"
        say(about + "".join(told))
        print_table(rows, {"seed": "seed", **_headings(group)})
        say("")
    between: tuple[str, ...] = ()
    for alike in _by_environment(found):
        if len(alike) > 1:
            environment = alike[0][0].environment
            say(*between, f"{environment}: mean ± standard deviation; seeds: with the first metric, of all")
            columns = {"spec": "spec", "seeds": "seeds", **_headings(alike[0])}
            print_table([_overview_row(group) for group in alike], columns)
            between = ("",)


def print_overviews(found: "list[Comparison]", kind: Format) -> None:
    """Print a table for a document for each environment, with a row for each spec."""
    for alike in _by_environment(found):
        names = ["spec", "seeds", *(item.metric for item in alike[0])]
        print_rows([_overview_row(group) for group in alike], {name: name for name in names}, kind)


def _by_environment(found: "list[Comparison]") -> "list[list[list[Comparison]]]":
    """Return the comparisons by environment, and in it those of each spec together."""
    specs = [list(metrics) for _, metrics in groupby(found, key=lambda item: item.spec_hash)]
    return [list(groups) for _, groups in groupby(specs, key=lambda group: group[0].environment)]


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


def comparison_row(item: "Comparison", seeds: Sequence[int], kind: Format) -> dict[str, Any]:
    """Return one spec and metric as a row of CSV (with a column for each seed) or JSON."""
    each = {seed: item.states[seed].value if value is None else value for seed, value in item.values.items()}
    row = {
        "method": item.method,
        "environment": item.environment,
        "profile": item.profile,
        "settings": item.settings,
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
