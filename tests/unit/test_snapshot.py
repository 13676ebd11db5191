"""State as bytes: every array comes back bit for bit, and forged bytes cost no memory."""

from __future__ import annotations

from typing import Any

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


def test_a_snapshot_of_version_9_is_read_as_it_was_written() -> None:
    head = msgspec.msgpack.encode(["<f8", [3]])
    whole = msgspec.msgpack.Ext(1, bytes([len(head)]) + head + np.arange(3.0).tobytes())
    rows = [{"x": 1.0, "array": whole}, {"x": 2.0, "array": whole}]
    state = unpack(msgspec.msgpack.encode({"version": 9, "state": {"estimation": {"state": {"records": rows}}}}))
    assert [(own["x"], *own["array"]) for own in state["estimation"]["state"]["records"]] == [
        (1.0, 0.0, 1.0, 2.0),
        (2.0, 0.0, 1.0, 2.0),
    ]


def test_zeros_take_little_room() -> None:
    assert len(pack({"a": np.zeros(1000)})) < 200
    assert len(pack({"a": np.ones(1000)})) < 8060


ROWS = [
    {"x": -0.0, "word": "a", "pair": (1.0, 2.0), "array": np.zeros((2, 3)), "own": {"y": k, "none": None}}
    for k in range(50)
]
LISTS: list[list[Any]] = [
    ROWS,
    [*ROWS, {"x": 1.0}],
    [{}, {}],
    [{"x": 1.0, "y": 2.0}, {"y": 1.0, "x": 2.0}],
    [np.array(0.0), np.zeros((0, 3)), np.arange(6.0).reshape(2, 3), np.array([-0.0])],
    [np.zeros(2), np.zeros(2, dtype=int)],
    [np.zeros(5000), np.ones(3)],
    [1.0, float("nan"), float("inf"), -0.0],
    [1.0, 2],
    ["a", "", "a"],
    ["a", None, True],
]


@pytest.mark.parametrize("rows", LISTS, ids=range(len(LISTS)))
def test_a_list_comes_back_bit_for_bit(rows: list[Any]) -> None:
    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.dtype.str, value.shape, value.tobytes()
        if isinstance(value, dict):
            return [(key, plain(own)) for key, own in value.items()]
        return [plain(own) for own in value] if isinstance(value, list | tuple) else (type(value), repr(value))

    assert plain(unpack(pack({"a": rows}))["a"]) == plain(rows)


def test_a_list_of_records_holds_names_and_heads_of_arrays_once() -> None:
    one = {"a_long_name_of_a_field": np.arange(1.0, 4.0), "another_long_name_of_a_field": 1.0}
    assert len(pack({"records": [one] * 1000})) < 1000 * (3 * 8 + 8 + 1) + 300


@pytest.mark.slow
def test_samples_of_a_dead_device_do_not_make_a_snapshot_unreadable() -> None:
    samples = np.zeros((6_000_000, 3))
    assert unpack(pack({"sensor": samples}))["sensor"].shape == samples.shape


def _forged(shape: list[int], data: bytes, code: int = 2) -> bytes:
    head = msgspec.msgpack.encode(["<f8", shape])
    array = msgspec.msgpack.Ext(code, bytes([len(head)]) + head + data)
    return msgspec.msgpack.encode({"version": VERSION, "state": {"a": array}})


def _extension(code: int, content: Any) -> bytes:
    extension = msgspec.msgpack.Ext(code, msgspec.msgpack.encode(content))
    return msgspec.msgpack.encode({"version": VERSION, "state": {"a": extension}})


def _nested(depth: int) -> bytes:
    content: Any = 0
    for _ in range(depth):
        content = msgspec.msgpack.Ext(3, msgspec.msgpack.encode({"a": [content]}))
    return msgspec.msgpack.encode({"version": VERSION, "state": {"a": content}})


@pytest.mark.slow
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
        _forged([1], bytes(8), code=99),
        _extension(3, {"a": [1], "b": [1, 2]}),
        _extension(3, [1]),
        _extension(3, {"a": [None] * 2_000_000}),
        _extension(5, [["a"], [1]]),
        _extension(6, ["<f8", [[1]], [0, 0], bytes(8)]),
        _extension(6, ["<f8", [[1]], [], b""]),
        _extension(6, ["O", [[1]], [0], bytes(8)]),
        _extension(6, ["<f8", [[0]], [0] * 2_000_000, b""]),
        _extension(7, ["<f8", [[1 << 40]], [0], bytes(8)]),
        _extension(7, ["<f8", [[-1]], [0], bytes(8)]),
        _nested(5000),
    ],
    ids=[
        "vast",
        "cut",
        "no bits",
        "less than nothing",
        "far less",
        "one value for two",
        "three",
        "dense",
        "unknown",
        "columns",
        "no columns",
        "rows",
        "a word too far",
        "too few values",
        "no arrays",
        "objects",
        "empty arrays",
        "vast arrays",
        "less",
        "nested",
    ],
)
def test_forged_arrays_are_refused(forged: bytes) -> None:
    with pytest.raises(ValueError, match="not a snapshot"):
        unpack(forged)
