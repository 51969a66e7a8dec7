"""Conditions on stored runs, and their order, by keys of the spec, metrics and columns."""

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.store import RunState, Store
from ssmail.store.conditions import SIGNS, Condition, in_order, matching, specs_in_order

NAMES = ("low", "high", "bc", "lost", "without")


@pytest.fixture
def names(store: Store) -> dict[str, str]:
    """Runs by name: of two gammas, of bc, one that diverged, and one without a metric."""

    def add(seed: int, error: float | None, *settings: str, method: str = "ssail", state: str = "finished") -> str:
        spec = build_spec(method, "yjunction", "smoke", settings)
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu")
        if error is not None:
            writer.final(1, {"test/mode_mse": error, "train/mode_mse": 1.0})
        writer.finish(RunState(state))
        return writer.run_id

    ids = (
        add(0, 0.001, "sac.gamma=0.5"),
        add(1, 0.25, "sac.gamma=0.9", "self_supervision.alpha=[0,1]"),
        add(2, 0.5, method="bc"),
        add(3, float("nan"), "sac.gamma=0.9", state="diverged"),
        add(4, None, "sac.gamma=0.9", "sac.encoder_steps=3", state="failed"),
    )
    return dict(zip(ids, NAMES, strict=True))


@pytest.fixture
def meets(store: Store, names: dict[str, str]) -> Callable[..., str]:
    """meets("sac.gamma=0.5") -> the names of the runs that meet all of the conditions."""
    return lambda *texts: " ".join(
        names[run.id] for run in matching(store, store.runs(), [*map(Condition.parse, texts)])
    )


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["sac.gamma=0.9"], "high lost without"),
        (["sac.gamma==0.90"], "high lost without"),
        (["sac.gamma != 0.9"], "low"),  # bc has no gamma
        (["sac.gamma<0.9"], "low"),
        (["sac.gamma>=0.5"], "low high lost without"),
        (["test/mode_mse<0.003"], "low"),
        (["test/mode_mse<=0.25"], "low high"),
        (["test/mode_mse>0.1", "sac.gamma=0.9"], "high"),
        (["self_supervision.alpha=[0, 1]"], "high"),
        (["self_supervision.alpha!=[0,1]"], "low lost without"),
        (["sac.encoder_steps=null"], "low high lost"),
        (["sac.encoder_steps!=null"], "without"),
        (["sac.encoder_steps>2"], "without"),
        (["sac.automatic_temperature=true"], "low high lost without"),
        (["sac.automatic_temperature=1"], ""),
        (["curriculum.name=trajectory-forcing"], "low high lost without"),
        (["method=bc"], "bc"),
        (["env=yjunction", "seed>=3"], "lost without"),
        (["state=diverged"], "lost"),
        (["seed!=0", "seed!=1"], "bc lost without"),
        (["started>2020-01-01"], "low high bc lost without"),
        (["wasserstein.clip=1"], ""),  # a key that none of these methods has
        ([], "low high bc lost without"),
    ],
)
def test_conditions(meets: Callable[..., str], texts: list[str], expected: str) -> None:
    assert meets(*texts) == expected


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("sac.gamma", "'sac.gamma' is no condition; write one as sac.gamma=0.9 or "),
        ("sac.gamma=", "'sac.gamma=' is no condition"),
        ("=0.9", "'=0.9' is no condition"),
        ("sac.gamma=[", r"'sac.gamma=\[' is no condition"),
        ("sac.gamma<fast", "sac.gamma is 0.5 in a run, which has no order with fast"),
        ("curriculum.name<3", "curriculum.name is trajectory-forcing in a run, which has no order with 3"),
        ("gamma=0.9", r"no run here has a key or metric 'gamma'; did you mean sac.gamma\?"),
        ("mode_mse<0.1", r"no run here has a key or metric 'mode_mse'; did you mean test/mode_mse\?"),
        ("sac.gama=0.9", r"did you mean sac.gamma\?"),
        ("test/mode_mes<1", r"did you mean test/mode_mse\?"),
        ("sed=1", r"did you mean seed\?"),
        ("xyzzy=1", "`ssmail config keys` lists the keys, `ssmail runs show RUN` the metrics"),
    ],
)
def test_what_is_no_condition_is_one_sentence(meets: Callable[..., str], text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        meets(text)


@given(
    number=st.floats(allow_nan=False, allow_infinity=False),
    value=st.floats(allow_nan=False),
    sign=st.sampled_from([*SIGNS]),
)
def test_numbers_are_compared_as_numbers(number: float, value: float, sign: str) -> None:
    condition = Condition.parse(f"a.b {sign} {number!r}")
    assert condition.value == number
    assert (
        condition.holds(value)
        is {
            "=": value == number,
            "==": value == number,
            "!=": value != number,
            "<": value < number,
            "<=": value <= number,
            ">": value > number,
            ">=": value >= number,
        }[sign]
    )


@given(text=st.text(max_size=20))
def test_any_text_is_a_condition_or_a_sentence(text: str) -> None:
    with contextlib.suppress(InputError):
        assert Condition.parse(text).name in text


@pytest.mark.parametrize(
    ("name", "descending", "expected"),
    [
        ("test/mode_mse", False, "low high bc lost without"),
        ("test/mode_mse", True, "bc high low lost without"),  # what has no number is last in either order
        ("sac.gamma", False, "low high lost without bc"),
        ("sac.gamma", True, "high lost without low bc"),
        ("seed", True, "without lost bc high low"),
        ("method", False, "bc low high lost without"),
    ],
)
def test_orders(store: Store, names: dict[str, str], name: str, descending: bool, expected: str) -> None:
    assert " ".join(names[run.id] for run in in_order(store, store.runs(), name, descending)) == expected


def test_specs_are_ordered_by_their_means(store: Store) -> None:
    def add(seed: int, gamma: float, error: float) -> None:
        spec = build_spec("ssail", "yjunction", "smoke", [f"sac.gamma={gamma}"])
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu", repeat=True)
        writer.final(1, {"test/mode_mse": error})
        writer.finish(RunState.FINISHED)

    for seed, gamma, error in ((0, 0.5, 0.1), (0, 0.6, 0.2), (1, 0.5, 0.5), (1, 0.6, 0.3), (0, 0.7, 9), (0, 0.7, 0.29)):
        add(seed, gamma, error)  # means: 0.3, 0.25; and 0.29, because of a seed the newest run counts

    def order(descending: bool) -> list[float]:
        runs = specs_in_order(store, store.runs(), "test/mode_mse", descending)
        return list(dict.fromkeys(run.spec["sac"]["gamma"] for run in runs))

    assert (order(False), order(True)) == ([0.6, 0.7, 0.5], [0.5, 0.7, 0.6])
    assert len(specs_in_order(store, store.runs(), "seed")) == 6
