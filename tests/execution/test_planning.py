"""How long cells take, and which share a process."""

import dataclasses
import json
import math
from collections import Counter
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.execution.cells import Cell
from ssmail.execution.planning import estimated_seconds, least_seconds, longest_first, shares, total_seconds
from ssmail.store import RunRow, Store


def smoke(*overrides: str, method: str = "ssail") -> RunSpec:
    return build_spec(method, "yjunction", "smoke", overrides)


@pytest.fixture
def row(store: Store) -> RunRow:
    """Of a run of profile smoke."""
    store.start_run(smoke(), 0, dataset_hash=None, device="cpu")
    return store.runs()[0]


def took(row: RunRow, spec: RunSpec, seconds: float) -> RunRow:
    """The row as it is after so many seconds of the spec."""
    values = {"method": spec.method, "profile": spec.profile, "spec_json": spec.as_json(), "spec_hash": spec.hash()}
    return dataclasses.replace(row, wall_seconds=seconds, **values)


def test_runs_of_the_spec_itself_tell_the_time(row: RunRow) -> None:
    spec, other = smoke(), smoke("training.epochs=30")
    runs = [took(row, spec, seconds) for seconds in (10.0, 40.0, 12.0)] + [took(row, other, 1e6)]
    assert estimated_seconds(runs, [spec]) == {spec: 12.0}


def test_other_runs_of_the_method_are_scaled_by_their_updates(row: RunRow) -> None:
    spec = smoke("training.epochs=30", "training.updates=20")  # 600 updates
    ten, twenty = smoke("training.epochs=5", "training.updates=2"), smoke("training.epochs=20", "training.updates=1")
    runs = [took(row, ten, 20.0), took(row, twenty, 80.0), took(row, twenty, 60.0)]  # 2, 4 and 3 seconds each
    assert estimated_seconds(runs, [spec]) == {spec: 1800.0}
    strangers = [took(row, ten.model_copy(update={"profile": "quick"}), 1.0), took(row, smoke(method="gail"), 1.0)]
    assert estimated_seconds([*runs, *strangers], [spec]) == {spec: 1800.0}
    assert estimated_seconds(strangers, [spec]) == {spec: None}


def test_smaller_runs_of_another_profile_tell_the_least_time(row: RunRow) -> None:
    large = build_spec("ssail", "yjunction", "paper", ["training.epochs=100", "training.updates=10"])  # 1000 updates
    small = build_spec("ssail", "yjunction", "quick", ["training.epochs=10", "training.updates=10"])
    assert least_seconds([took(row, small, 50.0)], large) == 500.0
    assert estimated_seconds([took(row, small, 50.0)], [large]) == {large: None}
    assert least_seconds([took(row, large, 900.0)], small) is None  # a larger network tells nothing
    assert least_seconds([took(row, smoke(method="gail"), 1.0)], large) is None


def test_references_take_no_updates(row: RunRow) -> None:
    reference, trained = smoke(method="copy-last"), smoke()
    assert json.loads(reference.as_json())["training"] is None
    known = estimated_seconds([took(row, reference, 2.0)], [reference, trained])
    assert known == {reference: 2.0, trained: None}


@pytest.mark.parametrize(
    ("each", "jobs", "seconds"),
    [([], 2, 0), ([4, 2, 2], 1, 8), ([4, 2, 2], 2, 4), ([6, 2, 2], 2, 6), ([4, 2], 8, 4)],
)
def test_runs_side_by_side_take_no_less_than_the_longest(each: list[float], jobs: int, seconds: float) -> None:
    assert total_seconds(each, jobs) == seconds


def test_long_and_unknown_cells_come_first() -> None:
    short, long, unknown, vast = (smoke(f"training.epochs={epochs}") for epochs in (1, 2, 3, 4))
    cells = [Cell(spec, seed) for spec in (short, unknown, long, vast) for seed in (1, 0)]
    ordered = longest_first(cells, {short: 1.0, long: 2.0, unknown: None, vast: None})
    assert [cell.spec.epochs for cell in ordered] == [4, 4, 3, 3, 2, 2, 1, 1]
    assert [cell.seed for cell in ordered] == [1, 0] * 4


TOGETHER = [smoke(), smoke("training.epochs=9"), smoke(method="gail"), smoke(method="wail")]
APART = [smoke("sac.encoder_steps=5"), smoke(method="bc"), smoke(method="nri"), smoke(method="copy-last")]


@given(
    chosen=st.lists(st.tuples(st.sampled_from(TOGETHER + APART), st.integers(0, 9)), unique=True, max_size=30),
    jobs=st.integers(1, 6),
)
def test_every_cell_has_one_process_and_only_seeds_of_a_spec_share_one(
    chosen: list[tuple[RunSpec, int]], jobs: int
) -> None:
    cells = [Cell(spec, seed) for spec, seed in chosen]
    divided = shares(cells, jobs)
    assert all(divided)
    assert Counter(chain.from_iterable(divided)) == Counter(cells)
    for share in divided:
        (spec,) = {cell.spec for cell in share}
        of_spec = [cell for cell in cells if cell.spec == spec]
        assert len(share) <= (math.ceil(len(of_spec) / jobs) if spec in TOGETHER else 1)
        first = of_spec.index(share[0])
        assert share == of_spec[first : first + len(share)]  # in their order
    for spec in TOGETHER:
        assert sum(share[0].spec == spec for share in divided) <= jobs  # all begin at once if there is one spec


def test_ten_seeds_on_two_and_on_four_processes_by_hand() -> None:
    cells = [Cell(TOGETHER[0], seed) for seed in range(10)]
    assert [len(share) for share in shares(cells, 2)] == [5, 5]
    assert [len(share) for share in shares(cells, 4)] == [3, 3, 3, 1]
    assert [len(share) for share in shares([Cell(APART[0], seed) for seed in range(3)], 2)] == [1, 1, 1]
    assert shares([], 2) == []
