"""Time of putting cells into the queue, of claiming one, and of `ssmail queue`, against the number that waits.

`python benchmarks/claiming.py --db URL --db URL` measures SQLite files and two empty databases on a server. The cells
have either 100 specs or one. Each size is measured in the same database after the one before, from which only claims
were taken. Claims are those of a worker, of one cell or of eight seeds, in one transaction each.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.store import Store

SIZES = (1_000, 10_000, 100_000)
SPECS = (100, 1)
TOGETHER = (1, 8)
CLAIMS = 50  # that are timed
COLUMNS = ("database", "specs", "waiting", "add_ms", "claim_ms", "slowest_ms", "claim_8_ms", "slowest_8_ms")
LIST = """
import sys
from ssmail.store.run_metadata import peak_memory_bytes
from ssmail_cli.main import run
code = run(["queue", "--db", sys.argv[1]])
print(peak_memory_bytes() / 2**20, file=sys.stderr)
sys.exit(code)
"""
SHOWN = (*COLUMNS, "queue_s", "queue_mb")


def specs_of(count: int) -> list[RunSpec]:
    """Build so many specs that differ in one value."""
    return [build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={0.9 + place / 10_000}"]) for place in range(count)]


def measure(where: str, specs: int, sizes: Sequence[int], claims: int = CLAIMS) -> list[dict[str, float | str]]:
    """Return a row of COLUMNS for each size, the smallest first. The database must be empty."""
    store = Store.open(where, stale_seconds=1e6)  # claims of earlier sizes stay as they are
    name, rows, added = store.url.partition("+")[0].partition(":")[0], [], 0
    for size in sizes:
        each = specs_of(specs)
        cells = [(spec, seed) for spec in each for seed in range(added // specs, size // specs)]
        add_ms = 1000 * seconds(lambda cells=cells: store.queue.add(cells)) / len(cells)
        added = size
        row: dict[str, float | str] = {"database": name, "specs": specs, "waiting": size, "add_ms": add_ms}
        for together, suffix in zip(TOGETHER, ("", "_8"), strict=True):
            taken = [seconds(lambda most=together: claim(store, most)) for _ in range(claims)]
            row[f"claim{suffix}_ms"] = 1000 * statistics.median(taken)
            row[f"slowest{suffix}_ms"] = 1000 * max(taken)
        rows.append(row)
        queue_s, queue_mb = listed(store.url)
        rows[-1] |= {"queue_s": queue_s, "queue_mb": queue_mb}
        print("  ".join(f"{shown(row[column]):>12}" for column in SHOWN), flush=True)
    store.close()
    return rows


def claim(store: Store, most: int) -> None:
    """Claim so many cells of one spec, or what is left of it."""
    found = store.queue.claim_waiting(lambda row, waiting: min(most, waiting), set())
    assert 0 < len(found) <= most


def listed(where: str) -> tuple[float, float]:
    """Return the seconds and the peak memory in MB of `ssmail queue` in a new process."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", LIST, where], capture_output=True, text=True, check=True)
    return time.perf_counter() - began, float(done.stderr.splitlines()[-1])


def seconds(work: Callable[[], object]) -> float:
    """Return the wall-clock seconds of a call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def shown(value: float | str) -> str:
    """Return a value for the table."""
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def report(urls: Sequence[str] = (), sizes: Sequence[int] = SIZES) -> None:
    """Measure an SQLite file, and beside it one of the empty databases on a server, for each of SPECS."""
    print("  ".join(f"{column:>12}" for column in SHOWN), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for place, count in enumerate(SPECS):
            for where in [str(Path(folder) / f"{count}.db"), *urls[place : place + 1]]:
                measure(where, count, sizes)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--db", action="append", default=[], help="an empty database on a server, one for each of SPECS"
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    arguments = parser.parse_args()
    report(arguments.db, arguments.sizes)
