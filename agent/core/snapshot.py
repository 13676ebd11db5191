"""Converts state to bytes and back. Every float keeps its bits."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from agent.core.earlier import brought_up

VERSION = 9
_ARRAY, _SPARSE = 1, 2  # msgpack extension codes of a numpy array: all its elements, or those that are not zero
# Elements of a sparse array, and of all together. Larger arrays are samples, which a dead device fills with zeros: they
# are always whole, so that a snapshot is never refused for them. A hundred channels of 650 records have fewer.
_LARGEST_SPARSE, _MOST_SPARSE = 1 << 12, 1 << 24


def pack(state: dict[str, Any]) -> bytes:
    """Bytes of nested dicts and lists of str, int, float, bool, None and numpy arrays.

    Equal states give equal bytes.
    """
    return _ENCODER.encode({"version": VERSION, "state": state})


def unpack(data: bytes) -> dict[str, Any]:
    """The state in the bytes of `pack`. Of a version before 9, what agent.core.earlier leaves of it.

    Raises ValueError if the bytes are no snapshot, or if this program does not know their version.
    """
    try:
        held = msgspec.msgpack.decode(data, ext_hook=_PackedArrays().decode)
        version, state = held["version"], held["state"]
    except (msgspec.DecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a snapshot: {error}") from None
    if not isinstance(state, dict) or not isinstance(version, int) or not 1 <= version <= VERSION:
        raise ValueError(f"the snapshot has version {version}, but this program reads versions 1 to {VERSION} only")
    if version < VERSION:
        try:
            brought_up(version, state)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the snapshot has version {version} and cannot be brought up to version {VERSION}: {error!r}"
            ) from None
    return state


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        head = msgspec.msgpack.encode([value.dtype.str, list(value.shape)])
        code, data = _ARRAY, np.ascontiguousarray(value).tobytes()
        if value.size <= _LARGEST_SPARSE and len(sparse := _without_zeros(data, value.dtype.itemsize)) < len(data):
            code, data = _SPARSE, sparse
        return msgspec.msgpack.Ext(code, bytes([len(head)]) + head + data)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a snapshot cannot hold a {type(value).__name__}")


def _without_zeros(data: bytes, size: int) -> bytes:
    """A bit for each element of so many bytes, 1 where it is not all zeros (so -0.0 is kept), and these elements."""
    elements = np.frombuffer(data, dtype=np.dtype((np.void, size)))
    there = np.asarray(elements != np.zeros((), elements.dtype))
    return bytes(np.packbits(there).tobytes() + elements[there].tobytes())


class _PackedArrays:
    """The arrays of one snapshot. Whoever wrote it, they take no more memory than its bytes and _MOST_SPARSE allow."""

    def __init__(self) -> None:
        self._left = _MOST_SPARSE

    def decode(self, code: int, data: memoryview) -> Any:
        """The array of an extension."""
        if code not in (_ARRAY, _SPARSE):
            raise ValueError(f"unknown extension {code}")
        raw = bytes(data)
        start = 1 + raw[0]
        name, shape = msgspec.msgpack.decode(raw[1:start])
        dtype = np.dtype(name)
        if code == _ARRAY:
            return np.frombuffer(raw, dtype=dtype, offset=start).reshape(shape).copy()
        size = math.prod(shape)
        self._left -= size
        if self._left < 0:
            raise ValueError(f"its sparse arrays have more than {_MOST_SPARSE} elements")
        found, end = np.zeros(size, dtype=dtype), start + (size + 7) // 8
        there = np.unpackbits(np.frombuffer(raw[start:end], dtype=np.uint8), count=size).astype(bool)
        values = np.frombuffer(raw, dtype=dtype, offset=end)
        if len(values) != np.count_nonzero(there):
            raise ValueError(f"a sparse array has {len(values)} values")
        found[there] = values
        return found.reshape(shape)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode)
