"""Converts state to bytes and back. Every float keeps its bits."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from agent.core.earlier import brought_up

VERSION = 9
_ARRAY = 1  # msgpack extension code for a numpy array


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
        held = msgspec.msgpack.decode(data, ext_hook=_decode_array)
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
        return msgspec.msgpack.Ext(_ARRAY, bytes([len(head)]) + head + np.ascontiguousarray(value).tobytes())
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a snapshot cannot hold a {type(value).__name__}")


def _decode_array(code: int, data: memoryview) -> Any:
    if code != _ARRAY:
        raise ValueError(f"unknown extension {code}")
    raw = bytes(data)
    start = 1 + raw[0]
    dtype, shape = msgspec.msgpack.decode(raw[1:start])
    return np.frombuffer(raw, dtype=np.dtype(dtype), offset=start).reshape(shape).copy()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode)
