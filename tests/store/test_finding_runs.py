"""Runs found again: by what they are, and by their ids."""

from typing import Any

import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError
from ssmail.store import RunState, Store


def test_filters(store: Store, spec: RunSpec) -> None:
    other = build_spec("ssail", "yjunction", "quick")
    ids = [
        store.start_run(chosen, seed, dataset_hash=None, device="cpu").run_id
        for chosen, seed in ((spec, 0), (spec, 1), (other, 0))
    ]
    store.end_dead_run(ids[1], RunState.FAILED, "")

    def found(**conditions: Any) -> list[int]:
        return [ids.index(row.id) for row in store.runs(**conditions)]

    assert found() == [0, 1, 2]  # newest last
    assert found(profile="quick") == [2]
    assert found(method="ssail", environment="yjunction", profile="smoke") == [0, 1]
    assert found(method="gail") == found(environment="mocap") == []
    assert found(state=RunState.FAILED) == found(state="failed") == [1]
    assert found(profile="smoke", state="running") == [0]
    assert found(ids=[ids[2], ids[0][:8].upper()]) == [0, 2]
    assert found(ids=[]) == []


def test_unknown_and_ambiguous_ids(store: Store, spec: RunSpec) -> None:
    ids = [store.start_run(spec, seed, dataset_hash=None, device="cpu").run_id for seed in range(17)]
    shared = next(digit for digit in "0123456789abcdef" if sum(run_id.startswith(digit) for run_id in ids) > 1)
    with pytest.raises(InputError, match=f"several run ids start with '{shared}'"):
        store.runs(ids=[shared])
    for unknown in ("zz", "%", "_", ""):
        with pytest.raises(InputError, match="no run id starts with"):
            store.runs(ids=[unknown])
    with pytest.raises(InputError, match="there is no run zz"):
        store.resume_run("zz", 0)
