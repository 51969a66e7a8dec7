"""Comparisons of specs over their seeds, as `ssmail runs compare` prints them."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from ssmail.errors import printable
from ssmail_cli.document_tables import markdown_text
from ssmail_cli.output import Format, print_rows, print_table, say, short
from ssmail_cli.run_table import EnvironmentMetrics, environment_metrics

if TYPE_CHECKING:
    from ssmail.store import RunRow, Store
    from ssmail.store.comparison import Comparison

MODEL = "test/"  # the prefix of a model's metrics; those of baselines have others
LONGEST_HEADING = 8  # characters, before it is broken


@dataclass(frozen=True)
class SpecsTable:
    """The compared specs of an environment, or of one data set in it: a row each, with the metrics of the columns.

    specs: the comparison of each spec by metric. They may have metrics that are no columns.
    """

    specs: "Sequence[Mapping[str, Comparison]]"
    columns: list[str]
    shown: EnvironmentMetrics

    @property
    def about(self) -> str:
        """ "flock (trajectories)" or "yjunction"."""
        return _about(_first(self.specs[0]))

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each spec, then those beside them."""
        return [_overview_row(spec, self.columns) for spec in self.specs] + [*self._beside()]

    def _beside(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each baseline; several where its values depend on the spec that it was stored with.

        A baseline that is itself a spec of the table gets no second row.
        """
        for label, prefix in self.shown.beside.items():
            known = [_means(spec, self.columns, MODEL) for spec in self.specs if _method(spec) == label]
            distinct = []
            for spec in self.specs:
                means = _means(spec, self.columns, f"{prefix}/")
                if means and not any(_agree(means, other) for other in known):
                    known.append(means)
                    distinct.append((spec, means))
            for spec, means in distinct:
                name = label if len(distinct) == 1 else f"{label}, as tested with {_label(spec)}"
                yield {"spec": name, "seeds": None, **{metric: f"{value:.3g}" for metric, value in means.items()}}


def compared(
    store: "Store", runs: "Sequence[RunRow]", metrics: Sequence[str] | None, *, beside: bool
) -> "list[Comparison]":
    """Compare the runs on each data set by the given metrics, or by those of the environment.

    beside: for tables, also by what stands beside the specs.
    """
    from ssmail.plots.data_sets import by_data
    from ssmail.store.comparison import compare_runs

    found = []
    for name, group in by_data(runs):
        shown = environment_metrics(group[0].environment)
        names = list(metrics or shown.compared)
        if beside:
            models = [metric.removeprefix(MODEL) for metric in names if metric.startswith(MODEL)]
            names += [f"{prefix}/{metric}" for prefix in shown.beside.values() for metric in models]
        found += compare_runs(store, group, list(dict.fromkeys(names)), name)
    return found


def print_comparisons(found: "list[Comparison]", metrics: Sequence[str] | None) -> None:
    """Print a table for each spec, with a row for each seed, mean, std and median and a column for each metric; then a
    table of the specs on each data set, if it has several rows.
    """
    tables = _tables(found, metrics)
    for table in tables:
        for spec in table.specs:
            _print_spec([spec[metric] for metric in table.columns], table.shown)
    between: tuple[str, ...] = ()
    for table in tables:
        rows = table.rows()
        if len(rows) > 1:
            say(*between, f"{table.about}: mean ± standard deviation; seeds: with the first metric, of all")
            columns = {"spec": "spec", "seeds": "seeds", **_headings(table.columns)}
            print_table(rows, columns, table.shown.spare, fold=True)
            between = ("",)


def print_overviews(found: "list[Comparison]", metrics: Sequence[str] | None, kind: Format) -> None:
    """Print a table for a document for each data set, with a row for each spec. A line before it names the data set."""
    tables = _tables(found, metrics)
    for number, table in enumerate(tables):
        if number:
            say("")
        if len(tables) > 1 or table.about != _first(table.specs[0]).environment:
            say(*([f"% {table.about}"] if kind is Format.LATEX else [markdown_text(table.about), ""]))
        print_rows(table.rows(), {name: name for name in ("spec", "seeds", *table.columns)}, kind)


def _tables(found: "list[Comparison]", metrics: Sequence[str] | None) -> list[SpecsTable]:
    tables = []
    for (_, environment), on_data in groupby(found, key=lambda item: (item.data_set, item.environment)):
        specs = [
            {item.metric: item for item in of_spec} for _, of_spec in groupby(on_data, key=lambda item: item.spec_hash)
        ]
        shown = environment_metrics(environment)
        columns = list(dict.fromkeys(metrics or shown.compared))
        if shown.beside and not metrics:
            columns = _telling(specs, columns) or columns
        tables.append(SpecsTable(specs, columns, shown))
    return tables


def _telling(specs: "Sequence[Mapping[str, Comparison]]", columns: Sequence[str]) -> list[str]:
    """Return the columns with a value for some model, but not a per-agent metric that equals the joint one."""
    known = [name for name in columns if name.startswith(MODEL) and any(spec[name].known for spec in specs)]
    return [name for name in known if not all(_repeats(spec, name) for spec in specs)]


def _repeats(spec: "Mapping[str, Comparison]", name: str) -> bool:
    """Return whether this is a per-agent metric with the values of the joint one."""
    joint = name.removesuffix("_agent")
    return joint != name and joint in spec and spec[joint].values == spec[name].values


def _headings(columns: Sequence[str]) -> dict[str, str]:
    names = {metric: printable(metric).replace("_constant_velocity", "\nconstant\nvelocity") for metric in columns}
    return {metric: "/\n".join(map(_broken, name.split("/"))) for metric, name in names.items()}


def _broken(name: str) -> str:
    """min_fde_20_agent in three lines; short names stay."""
    return re.sub(r"_(?=\d|agent)", r"\n_", name) if len(name) > LONGEST_HEADING else name


def _print_spec(items: "Sequence[Comparison]", shown: EnvironmentMetrics) -> None:
    first = items[0]
    rows: list[dict[str, Any]] = [
        {"seed": str(seed) if state == "finished" else f"{seed} {state}"}
        | {item.metric: item.values[seed] for item in items}
        for seed, state in first.states.items()
    ]
    for name in ("mean", "std", "median"):
        rows.append({"seed": name, **{item.metric: getattr(item, name) for item in items}})
    told = (f", {key}={short(value)}" for key, value in first.differs.items() if key not in first.changes)
    about = f"{first.method} on {_about(first)}, profile {first.settings}, spec {first.spec_hash[:8]}"
    say(about + "".join(told))
    print_table(rows, {"seed": "seed", **_headings([item.metric for item in items])}, shown.spare)
    say("")


def _first(spec: "Mapping[str, Comparison]") -> "Comparison":
    return next(iter(spec.values()))


def _method(spec: "Mapping[str, Comparison]") -> str:
    return _first(spec).method.replace("-", " ")


def _about(item: "Comparison") -> str:
    if item.data_set in (None, item.environment):
        return item.environment
    return f"{item.data_set} ({item.environment})"


def _label(spec: "Mapping[str, Comparison]") -> str:
    """The method, and in what the spec differs from the others of it."""
    first = _first(spec)
    differs = ", ".join(f"{key.rpartition('.')[2]} {short(value)}" for key, value in first.differs.items())
    return f"{first.method} {differs or first.spec_hash[:8]}"


def _overview_row(spec: "Mapping[str, Comparison]", columns: Sequence[str]) -> dict[str, Any]:
    first = spec[columns[0]]
    seeds = f"{len(first.known)}/{len(first.values)}"
    return {"spec": _label(spec), "seeds": seeds, **{metric: _mean_and_std(spec[metric]) for metric in columns}}


def _mean_and_std(item: "Comparison") -> str | None:
    if item.mean is None:
        return None
    return f"{item.mean:.3g}" if item.std is None else f"{item.mean:.3g} ± {item.std:.2g}"


def _means(spec: "Mapping[str, Comparison]", columns: Sequence[str], prefix: str) -> dict[str, float]:
    """Return the means of these columns, of the model or baseline whose metrics have this prefix."""
    items = {metric: spec.get(metric.replace(MODEL, prefix, 1)) for metric in columns if metric.startswith(MODEL)}
    return {metric: item.mean for metric, item in items.items() if item is not None and item.mean is not None}


def _agree(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Return whether the metrics that both have are equal up to rounding."""
    return all(math.isclose(one[metric], other[metric], rel_tol=1e-5) for metric in one.keys() & other.keys())


def comparison_row(item: "Comparison", seeds: Sequence[int], kind: Format) -> dict[str, Any]:
    """Return one spec and metric as a row of CSV (with a column for each seed) or JSON."""
    each = {seed: item.states[seed].value if value is None else value for seed, value in item.values.items()}
    row = {
        "method": item.method,
        "environment": item.environment,
        "data_set": item.data_set,
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
