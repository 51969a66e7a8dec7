"""What is too long for a column is refused in one sentence, by both kinds of database."""

import numpy as np
import pytest

from ssmail.config.experiments import build_spec
from ssmail.config.spec import RunSpec
from ssmail.errors import InputError, SsmailError
from ssmail.store import RunState, RunWriter, Store


def start(store: Store, spec: RunSpec) -> RunWriter:
    return store.start_run(spec, 0, dataset_hash="d" * 64, device="cpu")


def named(letters: int) -> RunSpec:
    return build_spec("ssail", "yjunction", "smoke").model_copy(update={"profile": "p" * letters})


@pytest.mark.parametrize("engine", ["remote", "store"])
def test_both_engines_have_the_same_limits(engine: str, request: pytest.FixtureRequest) -> None:
    each = request.getfixturevalue(engine)
    with pytest.raises(InputError, match=r"the run's profile 'p+ \.\.\. p+' has 65 characters, .* keeps 64; give a"):
        start(each, named(65))
    assert each.runs() == []
    writer = start(each, named(64))
    assert [run.profile for run in each.runs()] == ["p" * 64]
    with pytest.raises(InputError, match=r"the metric's name .* has 129 characters, of which the database keeps 128"):
        writer.epoch(1, {"m" * 129: 0.5})
    writer.epoch(1, {"m" * 128: 0.5})
    with pytest.raises(InputError, match=r"the array's name .* has 129 characters"):
        writer.arrays({"x" * 129: np.zeros(1)})
    with pytest.raises(InputError, match="has a null character"):
        writer.epoch(2, {"a\0b": 0.5})
    writer.finish(RunState.FAILED, "it printed \0 and died")
    assert each.runs()[0].error == "it printed \\0 and died"


def test_sqlite_itself_has_no_such_limit_but_the_server_has(remote: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control for the limits: without the check, the server answers with an error of its own."""
    monkeypatch.setattr("ssmail.store.queue.require_fitting", lambda *_: None)
    with pytest.raises(SsmailError, match="value too long for type character varying"):
        start(remote, named(65))
