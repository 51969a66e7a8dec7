import math
from typing import Any

import hypothesis.extra.numpy as hnp
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssmail.errors import InputError, SsmailError
from ssmail.store import RunWriter, Store
from ssmail.store.arrays import decode, encode

DTYPES = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(),
    hnp.unsigned_integer_dtypes(),
    hnp.floating_dtypes(),
    hnp.complex_number_dtypes(),
)
ARRAYS = DTYPES.flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
)


def assert_same(left: npt.NDArray[Any], right: npt.NDArray[Any]) -> None:
    assert left.dtype == right.dtype
    assert left.shape == right.shape
    assert left.tobytes() == right.tobytes()  # bit by bit: NaN payloads and signed zeros too


@given(ARRAYS)
def test_an_array_comes_back_bit_by_bit(array: npt.NDArray[Any]) -> None:
    assert_same(decode(**encode(array)), array)


@given(ARRAYS)
@settings(max_examples=30)
def test_memory_layout_does_not_matter(array: npt.NDArray[Any]) -> None:
    assert_same(decode(**encode(array.T)), array.T)
    assert_same(decode(**encode(array[::-1] if array.ndim else array)), array[::-1] if array.ndim else array)


def test_the_copy_can_be_written() -> None:
    copy = decode(**encode(np.zeros(3)))
    copy[0] = 1
    assert copy.tolist() == [1, 0, 0]


@pytest.mark.parametrize("array", [np.array([None]), np.array(["a"]), np.zeros(2, dtype=[("x", "f4")])])
def test_what_is_not_numeric_is_refused(array: npt.NDArray[Any]) -> None:
    with pytest.raises(SsmailError, match="cannot be stored"):
        encode(array)


def test_through_the_database(store: Store, writer: RunWriter) -> None:
    values = {
        "test/rollouts": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
        "nothing": np.zeros((0, 3), dtype=">i2"),
    }
    writer.arrays(values)
    assert store.array_names(writer.run_id) == ["nothing", "test/rollouts"]
    for name, value in values.items():
        assert_same(store.array(writer.run_id, name), value)
    writer.arrays({"nothing": np.array(math.pi)})
    assert store.array(writer.run_id, "nothing") == math.pi
    with pytest.raises(InputError, match=r"no array 'rollouts'; its arrays: nothing, test/rollouts"):
        store.array(writer.run_id, "rollouts")
