"""Converts state to bytes and back. Every float keeps its bits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import msgspec
import numpy as np

from agent.core.earlier import brought_up

VERSION = 10
SAME_STATE = 9  # from this version on the state is the same; version 9 wrote each dict of a list by itself
# Msgpack extension codes: a numpy array with all its elements, or with those that are not zero; a list of dicts of the
# same keys; a list of floats; a list of words; a list of arrays of one dtype, whole or sparse.
_ARRAY, _SPARSE, _TABLE, _FLOATS, _WORDS, _ARRAYS, _SPARSE_ARRAYS = range(1, 8)
# Elements of a sparse array, and of all together. Larger arrays are samples, which a dead device fills with zeros: they
# are always whole, so that a snapshot is never refused for them. A hundred channels of 650 records have fewer.
_LARGEST_SPARSE, _MOST_SPARSE = 1 << 12, 1 << 24
_MOST_THINGS, _BYTES_A_THING = 10_000, 4  # dicts and arrays of lists: so many, and one more for so many bytes


def pack(state: dict[str, Any]) -> bytes:
    """Bytes of nested dicts and lists of str, int, float, bool, None and numpy arrays.

    Equal states give equal bytes. A list of dicts is kept by column: the names stand there once, not in each record.
    """
    return _ENCODER.encode({"version": VERSION, "state": _compact(state)})


def unpack(data: bytes) -> dict[str, Any]:
    """The state in the bytes of `pack`. Of a version before 9, what agent.core.earlier leaves of it.

    Raises ValueError if the bytes are no snapshot, or if this program does not know their version.
    """
    try:
        held = msgspec.msgpack.decode(data, ext_hook=_PackedArrays(len(data)).decode)
        version, state = held["version"], held["state"]
    except (msgspec.DecodeError, LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise ValueError(f"not a snapshot: {error}") from None
    if not isinstance(state, dict) or not isinstance(version, int) or not 1 <= version <= VERSION:
        raise ValueError(f"the snapshot has version {version}, but this program reads versions 1 to {VERSION} only")
    if version < SAME_STATE:
        try:
            brought_up(version, state)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"the snapshot has version {version} and cannot be brought up to version {SAME_STATE}: {error!r}"
            ) from None
    return state


def _compact(value: Any) -> Any:
    """The same, with lists of things of one kind as one extension: of dicts with the same keys in the same order, of
    floats, words or arrays."""
    if isinstance(value, dict):
        return {key: _compact(own) for key, own in value.items()}
    if not isinstance(value, (list, tuple)):
        return value
    first = value[0] if len(value) > 1 else None
    if isinstance(first, dict) and first and all(isinstance(own, dict) and [*own] == [*first] for own in value):
        return _ext(_TABLE, {key: _compact([own[key] for own in value]) for key in first})
    if isinstance(first, float) and all(isinstance(own, float) for own in value):
        return msgspec.msgpack.Ext(_FLOATS, np.array(value).tobytes())
    if isinstance(first, str) and all(isinstance(own, str) for own in value):
        number = {word: k for k, word in enumerate(dict.fromkeys(value))}
        return _ext(_WORDS, [list(number), [number[word] for word in value]])
    if isinstance(first, np.ndarray) and all(isinstance(own, np.ndarray) and own.dtype == first.dtype for own in value):
        return _arrays(value)
    return [_compact(own) for own in value]


def _arrays(values: Sequence[np.ndarray[Any, Any]]) -> msgspec.msgpack.Ext:
    dtype, number = values[0].dtype, {shape: k for k, shape in enumerate(dict.fromkeys(own.shape for own in values))}
    code, data = _ARRAYS, b"".join(np.ascontiguousarray(own).tobytes() for own in values)
    small = max(own.size for own in values) <= _LARGEST_SPARSE
    if small and len(sparse := _without_zeros(data, dtype.itemsize)) < len(data):
        code, data = _SPARSE_ARRAYS, sparse
    return _ext(code, [dtype.str, list(number), [number[own.shape] for own in values], data])


def _ext(code: int, content: Any) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(code, _ENCODER.encode(content))


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
    """The lists and arrays of one snapshot of so many `octets`. Whoever wrote it, they take no more memory than its
    bytes, _MOST_SPARSE and _MOST_THINGS allow."""

    def __init__(self, octets: int) -> None:
        self._left, self._things = _MOST_SPARSE, _MOST_THINGS + octets // _BYTES_A_THING
        self._content = msgspec.msgpack.Decoder(ext_hook=self.decode)

    def decode(self, code: int, data: memoryview) -> Any:
        """What an extension holds."""
        raw = bytes(data)
        if code == _FLOATS:
            return np.frombuffer(raw).tolist()
        if code == _TABLE:
            return self._rows(self._content.decode(raw))
        if code == _WORDS:
            words, numbers = self._content.decode(raw)
            return [words[k] for k in numbers]
        if code in (_ARRAYS, _SPARSE_ARRAYS):
            return self._arrays(code, *self._content.decode(raw))
        if code not in (_ARRAY, _SPARSE):
            raise ValueError(f"unknown extension {code}")
        start = 1 + raw[0]
        name, shape = msgspec.msgpack.decode(raw[1:start])
        dtype = np.dtype(name)
        if code == _ARRAY:
            return np.frombuffer(raw, dtype=dtype, offset=start).reshape(shape).copy()
        return self._sparse(raw[start:], dtype, math.prod(shape)).reshape(shape)

    def _rows(self, columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
        rows = list(zip(*columns.values(), strict=True))
        self._makes(len(rows))
        return [dict(zip(columns, own, strict=True)) for own in rows]

    def _arrays(self, code: int, name: str, shapes: list[list[int]], numbers: list[int], data: bytes) -> list[Any]:
        dtype, own = np.dtype(name), [shapes[k] for k in numbers]
        self._makes(len(own))
        ends = list(accumulate(map(math.prod, own)))
        flat = np.frombuffer(data, dtype) if code == _ARRAYS else self._sparse(data, dtype, ends[-1])
        if len(flat) != ends[-1]:
            raise ValueError(f"arrays have {len(flat)} values")
        return [flat[end - math.prod(shape) : end].reshape(shape).copy() for shape, end in zip(own, ends, strict=True)]

    def _sparse(self, data: bytes, dtype: Any, size: int) -> np.ndarray[Any, Any]:
        self._left -= size
        if self._left < 0:
            raise ValueError(f"its sparse arrays have more than {_MOST_SPARSE} elements")
        found, end = np.zeros(size, dtype=dtype), (size + 7) // 8
        there = np.unpackbits(np.frombuffer(data[:end], dtype=np.uint8), count=size).astype(bool)
        values = np.frombuffer(data, dtype=dtype, offset=end)
        if len(values) != np.count_nonzero(there):
            raise ValueError(f"a sparse array has {len(values)} values")
        found[there] = values
        return found

    def _makes(self, things: int) -> None:
        self._things -= things
        if self._things < 0:
            raise ValueError("its lists have more dicts and arrays than its bytes allow")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode)
