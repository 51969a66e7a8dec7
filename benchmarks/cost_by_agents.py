"""CPU time against the number of agents N: of an update, a validation, a landscape and the start of a run.

Runs on Y-Junction at the sizes of profile quick, with jitter 0.01 so that many agents fit into the file. Each
measurement is a new process with one thread, so that its peak memory is its own. Beside the update stands its floor:
the bare matrix products of everything that the method applies to each pair of agents, forwards and backwards, in chunks
that fit into the processor's cache. It grows as N * (N - 1).

From 20 agents on, fewer trajectories are computed at once, down to a sixteenth, to save memory and time, and times are
scaled up to the numbers of the profile: they are proportional there. A start is measured without imports, which take as
long for any N.
"""

import argparse
import csv
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.plots import style
from ssmail.training.adversarial import AdversarialLearner, AdversarialTraining
from ssmail.training.landscape_recorder import LandscapeRecorder
from ssmail.training.loop import TrainingLoop

AGENTS = (3, 5, 10, 20, 30, 50, 100)
SHARE = {20: 2, 30: 4, 50: 8, 100: 16}  # one in so many of the trajectories, and of the agents of a landscape
UPDATES = 3  # in an epoch; the first is not counted
PAIRWISE = {  # beginnings of the names of the weights that are applied to every pair at every step
    "ssail": ["encoder.edges_in.second", "encoder.edges_out.second", "encoder.lstm", "encoder.head"],
    "dnri": [
        *(f"encoder.embedding.{name}" for name in ("edges_in.second", "edges_out.edge", "edges_out.second")),
        *(f"encoder.{name}" for name in ("past", "future", "prior_head", "posterior_head")),
        *(f"decoder.messages.types.{number}.second" for number in (0, 1)),
    ],
}
QUANTITIES = {"update": "o", "validation": "s", "landscape": "^", "start": "v"}  # with their markers
COLUMNS = ("method", "agents", "quantity", "cpu_ms", "floor_ms", "trajectories", "peak_mb")
ROWS = 2**13  # of a chunk of the floor's products

Row = dict[str, Any]


def spec_of(method: str, agents: int, share: int, *others: str) -> RunSpec:
    """Build the spec of profile quick for so many agents, with one in `share` of its trajectories at once."""
    plain = build_spec(method, "yjunction", "quick")
    assert plain.training is not None
    assert plain.data.yjunction is not None
    sizes = {
        "data.yjunction.agents": agents,
        "data.yjunction.jitter": 0.01,
        "data.yjunction.validation": plain.data.yjunction.validation // share,
        "evaluation.train_rollouts": plain.evaluation.train_rollouts // share,
        "training.batch": plain.training.batch // share,
        "training.updates": UPDATES,
    }
    if plain.adversarial is not None:
        sizes["adversarial.rollouts"] = plain.adversarial.rollouts // share
    return build_spec(method, "yjunction", "quick", [*(f"{key}={value}" for key, value in sizes.items()), *others])


def cpu_ms(work: Callable[[], object]) -> float:
    """Return the CPU milliseconds of a call."""
    begin = time.process_time()
    work()
    return 1000 * (time.process_time() - begin)


def updates(loop: TrainingLoop) -> list[float]:
    """Train an epoch and return the CPU milliseconds of each of its updates but the first."""
    learner: Any = loop.learner
    if isinstance(learner, AdversarialLearner):
        learner = AdversarialTraining([learner])
    name = "update" if hasattr(learner, "update") else "_update"
    original, taken = getattr(learner, name), []

    def timed(*given: Any, **named: Any) -> Any:
        kept: list[Any] = []
        taken.append(cpu_ms(lambda: kept.append(original(*given, **named))))
        return kept[0]

    setattr(learner, name, timed)
    learner.run_epoch(0)
    return taken[1:]


def floor_ms(loop: TrainingLoop) -> float:
    """Return the CPU milliseconds of the bare products of all pairs in an update of this run."""
    spec, network = loop.spec, loop.learner.predictor.model
    assert spec.training is not None
    names = tuple(PAIRWISE[spec.method])
    weights = [p.detach() for name, p in network.named_parameters() if name.startswith(names) and p.dim() == 2]
    agents, steps = loop.experts.states.shape[2], loop.experts.actions.shape[1]
    pairs = spec.training.batch * steps * agents * (agents - 1)
    return sum(products_ms(weight) for weight in weights) * pairs / ROWS


def products_ms(weight: Tensor, times: int = 30) -> float:
    """Return the CPU milliseconds of a layer's three products (output, both gradients) for ROWS rows."""
    x, g = torch.randn(ROWS, weight.shape[1]), torch.randn(ROWS, weight.shape[0])

    def products() -> None:
        torch.mm(x, weight.t())
        torch.mm(g, weight)
        torch.mm(g.t(), x)

    products()
    return min(cpu_ms(products) for _ in range(times))


def measure(method: str, agents: int) -> list[Row]:
    """Measure one method with so many agents in this process."""
    torch.set_num_threads(1)
    share = SHARE.get(agents, 1)
    spec = spec_of(method, agents, share)
    TrainingLoop(spec_of(method, 3, share), 0)  # imports what torch imports late
    found: dict[str, tuple[float, float | None]] = {"start": (cpu_ms(lambda: TrainingLoop(spec, 0)), None)}
    loop = TrainingLoop(spec, 0)
    floor = floor_ms(loop) * share
    found["update"] = statistics.median(updates(loop)) * share, floor
    found["validation"] = cpu_ms(lambda: loop.evaluator.epoch(loop.learner.predictor)) * share, None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    if method == "ssail":
        asked = TrainingLoop(spec_of(method, agents, share, "evaluation.landscapes=1"), 0).landscapes
        assert isinstance(asked, LandscapeRecorder)
        asked.weights = asked.weights[: -(-agents // share)]  # the agents that are moved over the plane
        found["landscape"] = cpu_ms(asked.reward_field) * agents / len(asked.weights), None
    assert spec.training is not None
    batch = spec.training.batch
    return [
        dict(zip(COLUMNS, (method, agents, name, round(value, 2), bare and round(bare, 2), batch, peak), strict=True))
        for name, (value, bare) in found.items()
    ]


def report(folder: Path, agents: Sequence[int] = AGENTS, methods: Sequence[str] = tuple(PAIRWISE)) -> None:
    """Measure and print a table, and write cost-vs-agents.csv and .png into the folder."""
    print(f"\n{'CPU ms':<8}{'agents':>8}{'start':>10}{'update':>10}{'floor':>10}{'validation':>12}{'landscape':>11}")
    rows: list[Row] = []
    for method in methods:
        for count in agents:
            words = [sys.executable, __file__, "--measure", method, str(count)]
            done = subprocess.run(words, stdout=subprocess.PIPE, check=True)
            found = {row["quantity"]: row for row in json.loads(done.stdout)}
            rows += found.values()
            taken = {name: row["cpu_ms"] for name, row in found.items()}
            shown = f"{taken['start']:10.0f}{taken['update']:10.1f}{found['update']['floor_ms']:10.1f}"
            shown += f"{taken['validation']:12.0f}{taken.get('landscape', float('nan')):11.0f}"
            print(f"{method:<8}{count:>8}{shown}", flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "cost-vs-agents.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    draw(rows, folder / "cost-vs-agents.png")
    print(f"wrote {folder / 'cost-vs-agents.csv'} and .png")


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw a panel for each method, both axes logarithmic, with a line of slope 2 through the last update."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    with style.sheet():
        figure = style.new_figure(height=3.2)
        figure.set_figwidth(2 * style.COLUMN_WIDTH)
        for axes, method in zip(figure.subplots(1, len(methods), sharey=True, squeeze=False)[0], methods, strict=True):
            own = [row for row in rows if row["method"] == method]
            agents = sorted({row["agents"] for row in own})
            for colour, (quantity, marker) in enumerate(QUANTITIES.items()):
                values = [(row["agents"], row["cpu_ms"]) for row in own if row["quantity"] == quantity]
                if values:
                    axes.plot(*zip(*values, strict=True), f"C{colour}", marker=marker, ms=3, lw=1, label=quantity)
            measured = [row for row in own if row["quantity"] == "update"]
            floor = [row["floor_ms"] for row in measured]
            axes.plot(agents, floor, "k--", lw=0.8, label="update: bare products of the pairs")
            last = measured[-1]["cpu_ms"] / agents[-1] ** 2
            axes.plot(agents, [last * n**2 for n in agents], color="0.7", lw=0.8, zorder=0, label="∝ N²")
            axes.set(xscale="log", yscale="log", xlabel="agents N", title=method)
            axes.set_xticks(agents, [str(n) for n in agents])
            axes.minorticks_off()
        figure.axes[0].set_ylabel("CPU time (ms)")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        figure.savefig(path, dpi=200)


def main(given: Sequence[str]) -> None:
    """Run the benchmark. `--measure METHOD AGENTS` is for this program's own subprocesses."""
    if given[:1] == ["--measure"]:
        print(json.dumps(measure(given[1], int(given[2]))))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", type=int, default=list(AGENTS))
    parser.add_argument("--methods", nargs="+", choices=PAIRWISE, default=list(PAIRWISE))
    parser.add_argument("--out", type=Path, default=Path("build"), help="folder of the CSV and the figure")
    chosen = parser.parse_args(given)
    report(chosen.out, chosen.agents, chosen.methods)


if __name__ == "__main__":
    main(sys.argv[1:])
