"""CPU seconds and peak memory of a training step of dnri and nri, as it is and in the plain form.

A step is `VariationalLearner._update`: data, forward, backward, clipping and Adam. The plain form (plain_form.py) does
the operations that the original does, in its order; weights, inputs and random numbers are the same. Each measurement
runs in a new process with one thread, so that its peak memory is its own; the forms take turns. The first step of each
process warms up and does not count, but its results are compared between the forms. Equality is checked in double
precision, at the same widths on windows of SHORT states: in single precision, each form is as far from the exact result
as from the other form.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from plain_form import in_plain_form
from torch import Tensor

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.data.scaling import Scaling
from ssmail.envs.integrator import Integrator
from ssmail.training.batches import Batch
from ssmail.training.learner import LearnerContext
from ssmail.training.seeding import Generators
from ssmail.training.variational import VariationalLearner

FORMS = ("plain", "fast")
BATCH = {"dnri": 4, "nri": 8}
SIZES = {  # agents, states in a window, and hidden, memory, head, decoder_hidden of `variational`
    "authors": (31, 50, (256, 64, 128, 256)),
    "quick": (31, 50, (32, 16, 16, 64)),
    "toy": (4, 6, (8, 5, 6, 7)),
}
ROUNDS, STEPS = 2, 2  # processes of each form, and timed steps of each process
HEADS = {("nri", "authors"): 256}  # where a method's `head` is another
SHORT = 7
TOLERANCE = 1e-9  # of results relative to their largest value, in double precision


def spec_of(method: str, size: str, states: int) -> RunSpec:
    """Build the spec of the published models in one of SIZES, for windows of `states`, which nri reads at once."""
    names = ("hidden", "memory", "head", "decoder_hidden")
    values = dict(zip(names, SIZES[size][2], strict=True))
    values["head"] = HEADS.get((method, size), values["head"])
    sizes = [f"variational.{name}={value}" for name, value in values.items()]
    inputs = ["root_relative=false", "agent_input=false", "standardize=false", f"encoder_window={states}"]
    types = ["edge_types=2", "first_type_is_none=true", "temperature=0.5"]
    fixed = [*inputs, *types, "decoder=recurrent", "batch_norm=true"]
    others = [f"training.batch={BATCH[method]}", "curriculum.name=teacher-forcing", "cloning.input_noise=0"]
    return build_spec(method, "mocap", "paper", [*sizes, *(f"variational.{value}" for value in fixed), *others])


def walkers(agents: int, steps: int) -> Batch:
    """Make 16 trajectories of oscillating agents in scaled units: states (16, steps, agents, 2 * 3)."""
    draw = torch.Generator().manual_seed(0)
    phase, pace = torch.rand(16, 1, agents, 3, generator=draw), 0.1 + 0.2 * torch.rand(16, 1, 1, 1, generator=draw)
    positions = 0.8 * torch.sin(6.3 * phase + pace * torch.arange(steps + 1).view(1, -1, 1, 1))
    states = torch.cat([positions[:, 1:], 3 * positions.diff(dim=1)], dim=-1)
    return Batch(states, states[:, 1:, :, 3:], torch.arange(16))


def make_learner(
    method: str, size: str, form: str, dtype: torch.dtype = torch.float32, states: int | None = None
) -> VariationalLearner:
    """Make a learner with the same weights and trajectories in each form; `states` overrides their length."""
    agents, states = SIZES[size][0], states or SIZES[size][1]
    scaling = Scaling(position_min=-1.0, position_max=1.0, velocity_min=-1.0 / 3, velocity_max=1.0 / 3)
    experts = walkers(agents, states)
    experts = Batch(experts.states.to(dtype), experts.actions.to(dtype), experts.source)
    context = LearnerContext(spec_of(method, size, states), experts, Integrator(scaling), Generators(0))
    learner = VariationalLearner(context)
    learner.model.to(dtype)
    if form == "plain":
        in_plain_form(learner.model.encoder)
        in_plain_form(learner.model.decoder)
    return learner


def one_step(learner: VariationalLearner) -> dict[str, float]:
    """Train one step under complete teacher forcing and return the metrics of the loss."""
    interventions = torch.ones(learner.training.batch, learner.context.steps, dtype=torch.bool)
    return learner._update(learner.context.experts, interventions)


def first_results(learner: VariationalLearner) -> dict[str, Tensor]:
    """Train one step; return the loss and its terms, the outputs of encoder and decoder, and all gradients."""
    seen: dict[str, Tensor] = {}

    def keep(name: str, made: Tensor | tuple[Tensor | None, ...]) -> None:
        for place, value in enumerate([made] if isinstance(made, Tensor) else made):
            if value is not None:
                seen[f"{name} {place}"] = value.detach().clone()

    parts = {"encoder": learner.model.encoder, "decoder": learner.model.decoder}
    hooks = [m.register_forward_hook(lambda _, __, made, name=name: keep(name, made)) for name, m in parts.items()]
    metrics = one_step(learner)
    for hook in hooks:
        hook.remove()
    gradients = {f"gradient of {name}": p.grad.clone() for name, p in learner.model.named_parameters()}
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in metrics.items()} | seen | gradients


def largest_difference(plain: dict[str, Tensor], fast: dict[str, Tensor]) -> tuple[float, float]:
    """Return the largest absolute difference, gradients aside, and the largest relative difference.

    A difference is relative to the largest value of its result.
    """
    absolute = relative = 0.0
    for name, value in plain.items():
        difference = float((value - fast[name]).abs().max())
        relative = max(relative, difference / max(float(value.abs().max()), 1e-12))
        if name.startswith(("encoder", "decoder")):
            absolute = max(absolute, difference)
    return absolute, relative


def check_equal(method: str, size: str) -> None:
    """Print how far the forms differ in double precision. Raises SystemExit if it is more than TOLERANCE."""
    made = (first_results(make_learner(method, size, form, torch.float64, SHORT)) for form in FORMS)
    _, relative = largest_difference(*made)
    if not relative <= TOLERANCE:
        raise SystemExit(
            f"the two forms of {method} differ by {relative:.1e} of the largest value: they are not the same"
        )
    print(f"  equal in double precision, gradients too: to {relative:.1e} of the largest value")


def measure(method: str, size: str, form: str, steps: int, results: str) -> dict[str, object]:
    """Measure in this process: the seconds of each step after the first, and the peak resident memory in MB."""
    torch.set_num_threads(1)
    learner, seconds = make_learner(method, size, form), []
    torch.save(first_results(learner), results)
    for _ in range(steps):
        begin = time.process_time()
        one_step(learner)
        seconds.append(time.process_time() - begin)
    return {"seconds": seconds, "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000}


def compare_steps(method: str, size: str, rounds: int, steps: int) -> None:
    """Print a line per form, and how far their results differ. Raises SystemExit like `check_equal`."""
    with tempfile.TemporaryDirectory() as folder:
        seconds: dict[str, list[float]] = {form: [] for form in FORMS}
        peak = dict.fromkeys(FORMS, 0.0)
        for form in FORMS * rounds:
            words = [method, size, form, str(steps), str(Path(folder) / form)]
            done = subprocess.run([sys.executable, __file__, "--measure", *words], stdout=subprocess.PIPE, check=True)
            measured = json.loads(done.stdout)
            seconds[form] += measured["seconds"]
            peak[form] = max(peak[form], measured["peak"])
        plain, fast = (torch.load(Path(folder) / form) for form in FORMS)
    median = {form: statistics.median(taken) for form, taken in seconds.items()}
    for form in FORMS:
        ratio = f"{median['plain'] / median[form]:8.2f}{peak['plain'] / peak[form]:8.2f}"
        print(f"{method + ', ' + size + ', ' + form:<34}{median[form]:10.3f}{peak[form]:10.0f}{ratio}", flush=True)
    absolute, relative = largest_difference(plain, fast)
    print(f"  in single precision: outputs to {absolute:.1e}, gradients to {relative:.1e} of the largest value")
    check_equal(method, size)


def report(
    sizes: Sequence[str], methods: Sequence[str] = tuple(BATCH), rounds: int = ROUNDS, steps: int = STEPS
) -> None:
    """Print a table of all sizes and methods."""
    print(f"\n{'training step':<34}{'CPU s':>10}{'peak MB':>10}{'faster':>8}{'smaller':>8}")
    for size in sizes:
        for method in methods:
            compare_steps(method, size, rounds, steps)


def main(given: Sequence[str]) -> None:
    """Run the benchmark. `--measure METHOD SIZE FORM STEPS FILE` is for this program's own subprocesses."""
    if given[:1] == ["--measure"]:
        method, size, form, steps, results = given[1:]
        print(json.dumps(measure(method, size, form, int(steps), results)))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help="only the sizes of the profile quick: seconds, not minutes"
    )
    parser.add_argument("--sizes", nargs="+", choices=SIZES)
    parser.add_argument("--methods", nargs="+", choices=BATCH, default=list(BATCH))
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="processes of each form")
    parser.add_argument("--steps", type=int, default=STEPS, help="timed steps of each process")
    chosen = parser.parse_args(given)
    sizes = chosen.sizes or (["quick"] if chosen.quick else ["authors", "quick"])
    report(sizes, chosen.methods, chosen.rounds, chosen.steps)


if __name__ == "__main__":
    main(sys.argv[1:])
