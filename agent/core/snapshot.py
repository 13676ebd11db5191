"""State as bytes and back, every float bit for bit."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

VERSION = 1
_ARRAY = 1  # msgpack extension code for a numpy array


def pack(state: dict[str, Any]) -> bytes:
    """Bytes of nested dicts and lists of str, int, float, bool, None and numpy arrays; equal state, equal bytes."""
    return _ENCODER.encode({"version": VERSION, "state": state})


def unpack(data: bytes) -> dict[str, Any]:
    """The state that `pack` took. Raises ValueError when the bytes are none, or of another version."""
    try:
        held = msgspec.msgpack.decode(data, ext_hook=_decode_array)
        version, state = held["version"], held["state"]
    except (msgspec.DecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a snapshot: {error}") from None
    if version != VERSION or not isinstance(state, dict):
        raise ValueError(f"a snapshot of version {version}; this program reads {VERSION}")
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
