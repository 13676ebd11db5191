"""State as bytes: every array comes back bit for bit, and forged bytes cost no memory."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from agent.core.snapshot import VERSION, pack, unpack

ARRAYS = [
    np.zeros((2, 3)),
    np.array([0.0, -0.0, 1.0, np.nan] * 5),
    np.zeros((0, 3)),
    np.array(0.0),
    np.asfortranarray(np.triu(np.arange(1.0, 37.0).reshape(6, 6))),
    np.array(["a", "", "b"]),
    np.array([True, False] * 9),
    np.array([0, 0, -(2**63)]),
    np.array([1.0 + 0.0j, 0.0]),
    np.arange(7.0),
]


@pytest.mark.parametrize("array", ARRAYS, ids=str)
def test_an_array_comes_back_bit_for_bit(array: np.ndarray) -> None:
    again = unpack(pack({"a": [array]}))["a"][0]
    assert (again.dtype, again.shape, again.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_zeros_take_little_room() -> None:
    assert len(pack({"a": np.zeros(1000)})) < 200
    assert len(pack({"a": np.ones(1000)})) < 8060


@pytest.mark.slow
def test_samples_of_a_dead_device_do_not_make_a_snapshot_unreadable() -> None:
    samples = np.zeros((6_000_000, 3))
    assert unpack(pack({"sensor": samples}))["sensor"].shape == samples.shape


def _forged(shape: list[int], data: bytes, code: int = 2) -> bytes:
    head = msgspec.msgpack.encode(["<f8", shape])
    array = msgspec.msgpack.Ext(code, bytes([len(head)]) + head + data)
    return msgspec.msgpack.encode({"version": VERSION, "state": {"a": array}})


@pytest.mark.parametrize(
    "forged",
    [
        _forged([1 << 40], bytes(8)),
        _forged([2], bytes(2)),
        _forged([9], bytes(1)),
        _forged([-4], bytes(8)),
        _forged([-(1 << 40)], bytes(8)),
        _forged([2], b"\xc0" + bytes(8)),
        _forged([2], b"\xc0" + bytes(24)),
        _forged([3], bytes(8), code=1),
        _forged([1], bytes(8), code=3),
    ],
    ids=["vast", "cut", "no bits", "less than nothing", "far less", "one value for two", "three", "dense", "unknown"],
)
def test_forged_arrays_are_refused(forged: bytes) -> None:
    with pytest.raises(ValueError, match="not a snapshot"):
        unpack(forged)
