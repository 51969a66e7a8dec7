"""Conversion of NumPy arrays to and from rows: compressed bytes with their dtype and shape."""

import json
import zlib
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from ssmail.errors import SsmailError


class EncodedArray(TypedDict):
    """The columns of an array: `dtype` such as "<f4", `shape` as a JSON list, `data` zlib-compressed in C order."""

    dtype: str
    shape: str
    data: bytes


def encode(array: npt.NDArray[Any]) -> EncodedArray:
    """Return the columns for `array`, of any shape.

    Raises SsmailError unless its dtype is boolean, integer, real or complex.
    """
    if array.dtype.kind not in "biufc":
        raise SsmailError(f"an array of dtype {array.dtype} cannot be stored; make it numeric or boolean")
    return EncodedArray(
        dtype=array.dtype.str, shape=json.dumps(array.shape), data=zlib.compress(array.tobytes(order="C"))
    )


def decode(dtype: str, shape: str, data: bytes) -> npt.NDArray[Any]:
    """Return the array that `encode` stored, as a writable copy."""
    return np.frombuffer(zlib.decompress(data), dtype=np.dtype(dtype)).reshape(json.loads(shape)).copy()
