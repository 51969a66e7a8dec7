"""Conversion of NumPy arrays to and from rows: compressed bytes with their dtype and shape."""

import json
import math
import re
import zlib
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from ssmail.errors import SsmailError

MOST_BYTES = 2**30
"""Size of the largest array, uncompressed."""
_MOST_DIMENSIONS = 32
_DTYPE = re.compile(r"[<>|=]?[biufc]\d{1,2}")


class UnreadableArrayError(ValueError):
    """What is wrong with the row of an array, in a few words."""


class EncodedArray(TypedDict):
    """The columns of an array: `dtype` such as "<f4", `shape` as a JSON list, `data` zlib-compressed in C order."""

    dtype: str
    shape: str
    data: bytes


def encode(array: npt.NDArray[Any]) -> EncodedArray:
    """Return the columns for `array`, of any shape.

    Raises SsmailError unless its dtype is boolean, integer, real or complex, and its size at most MOST_BYTES.
    """
    if array.dtype.kind not in "biufc":
        raise SsmailError(f"an array of dtype {array.dtype} cannot be stored; make it numeric or boolean")
    if array.nbytes > MOST_BYTES:
        raise SsmailError(f"an array of {array.nbytes} bytes cannot be stored; make it at most {MOST_BYTES}")
    return EncodedArray(
        dtype=array.dtype.str, shape=json.dumps(array.shape), data=zlib.compress(array.tobytes(order="C"))
    )


def decode(dtype: Any, shape: Any, data: Any) -> npt.NDArray[Any]:
    """Return the array that `encode` stored, as a writable copy.

    The values may be of any type. The size follows from dtype and shape, and no more than that is unpacked. Raises
    UnreadableArrayError for values that `encode` does not return.
    """
    kind, lengths = _dtype(dtype), _shape(shape)
    if kind.itemsize * math.prod(max(length, 1) for length in lengths) > MOST_BYTES:
        raise UnreadableArrayError(f"it has more than {MOST_BYTES} bytes")
    size = kind.itemsize * math.prod(lengths)
    if not isinstance(data, bytes | memoryview):
        raise UnreadableArrayError("its data is no bytes")
    unpacking = zlib.decompressobj()
    try:
        content = unpacking.decompress(data, size + 1)
    except zlib.error:
        raise UnreadableArrayError("its data cannot be unpacked") from None
    if len(content) != size or not unpacking.eof or unpacking.unused_data:
        raise UnreadableArrayError("its data is not of the size that its shape and dtype say")
    return np.frombuffer(content, dtype=kind).reshape(lengths).copy()


def _dtype(text: Any) -> np.dtype[Any]:
    if isinstance(text, str) and _DTYPE.fullmatch(text):
        try:
            return np.dtype(text)
        except TypeError:
            pass
    raise UnreadableArrayError("its dtype is not numeric or boolean")


def _shape(text: Any) -> list[int]:
    try:
        lengths = json.loads(text) if isinstance(text, str) and len(text) <= 1000 else None
    except (ValueError, RecursionError):
        lengths = None
    if (
        not isinstance(lengths, list)
        or len(lengths) > _MOST_DIMENSIONS
        or not all(type(length) is int and length >= 0 for length in lengths)
    ):
        raise UnreadableArrayError("its shape is not a list of lengths")
    return lengths
