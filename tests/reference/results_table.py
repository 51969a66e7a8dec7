"""The table of docs/results.md, from a database: mean ± standard deviation over the seeds of each method.

python -m tests.reference.results_table [DATABASE]   # writes the rows of its methods, by default of the reference
"""

import math
import sys
from collections.abc import Mapping
from pathlib import Path

from ssmail.config.experiments import build_spec
from ssmail.config.names import METHODS
from ssmail.plots.run_groups import Family, by_spec
from ssmail.store import Store
from ssmail.store.comparison import Comparison, compare_runs

ROOT = Path(__file__).parents[2]
PAGE, REFERENCE = ROOT / "docs" / "results.md", ROOT / "results" / "reference" / "reference.db"
DECIMALS = {"mode_mse": 4, "on_path": 2, "path_rms": 2, "lane_balance": 2, "min_fde_20": 1}
BASELINE = "constant velocity"


def rows(store: Store) -> dict[str, str]:
    """Return the row of each method that the database has, and of constant velocity, by its first cell.

    Of several specs of a method it is the one that figures prefer.
    """
    runs = [run for run in store.runs(environment="yjunction") if run.state.settled]
    found: dict[str, str] = {}
    for method in METHODS:
        own = [run for run in runs if run.method == method]
        current = build_spec(method, "yjunction", "quick").hash()
        families = [Family(tuple(found), found[0].spec_hash == current) for found in by_spec(own)]
        if families:
            chosen = max(families, key=lambda family: family.rank).runs
            found[method] = row(method, compare_runs(store, chosen, [f"test/{name}" for name in DECIMALS]))
            names = [f"test_constant_velocity/{name}" for name in DECIMALS]
            found.setdefault(BASELINE, row(BASELINE, compare_runs(store, chosen, names)))
    return found


def row(name: str, found: list[Comparison]) -> str:
    cells = [cell(item, DECIMALS[item.metric.rpartition("/")[2]], name == BASELINE) for item in found]
    if name == BASELINE:  # one answer for all starts, to whose lanes its balance and best sample mean nothing
        cells[3:] = ["", ""]
    return f"| {name} | {' | '.join(cells)} |"


def cell(item: Comparison, decimals: int, alone: bool) -> str:
    if item.mean is None:
        return "-"
    spread = "" if alone or item.std is None or math.isnan(item.std) else f" ± {item.std:.{decimals}f}"
    return f"{item.mean:.{decimals}f}{spread}"


def updated(page: str, new: Mapping[str, str]) -> str:
    """Return the page with these rows in place of its own of the same first cell."""
    lines = page.split("\n")
    begin = next(number for number, line in enumerate(lines) if line.startswith("| method | mode_mse |"))
    end = begin + lines[begin:].index("")
    lines[begin:end] = [new.get(line.split("|")[1].strip(), line) for line in lines[begin:end]]
    return "\n".join(lines)


def main() -> None:
    store = Store.open(sys.argv[1] if len(sys.argv) > 1 else REFERENCE)
    PAGE.write_text(updated(PAGE.read_text("utf-8"), rows(store)), "utf-8")


if __name__ == "__main__":
    main()
