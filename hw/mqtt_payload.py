"""Blocks of samples in the payload of an MQTT message: Sparkplug B, or JSON."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from hw.block import LARGEST
from hw.sparkplug_pb2 import Payload

MOST_METRICS = 1000  # of one device; more names are not kept
# Arrays by their data type (Eclipse Sparkplug 3.0.0, 6.4.16): little-endian, without anything between
ARRAYS = {
    22: "i1", 23: "<i2", 24: "<i4", 25: "<i8", 26: "u1", 27: "<u2", 28: "<u4", 29: "<u8", 30: "<f4", 31: "<f8",
}  # fmt: skip


class PayloadError(Exception):
    """A payload without the block of samples that is asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Samples (n, axes) of one message, the number of the first one and the time stamp in ms since 1970, if stated."""

    indications: NDArray[np.float64]
    counter: int | None
    stamp_ms: float | None


Decoder = Callable[[bytes], Block]


class Sparkplug:
    """Decodes Sparkplug B. Aliases and data types are learned from births."""

    def __init__(self, metrics: Sequence[str], counter: str) -> None:
        self._metrics = metrics
        self._counter = counter
        self._names: dict[int, str] = {}
        self._types: dict[str, int] = {}

    def learn(self, data: bytes) -> None:
        """Take a birth. Raises PayloadError."""
        for metric in _payload(data).metrics[:MOST_METRICS]:
            if metric.name in (*self._metrics, self._counter):
                self._types[metric.name] = metric.datatype
                if metric.HasField("alias"):
                    self._names = {alias: name for alias, name in self._names.items() if name != metric.name}
                    self._names[metric.alias] = metric.name

    def __call__(self, data: bytes) -> Block:
        """The block of a data message. Raises PayloadError."""
        payload = _payload(data)
        held = {metric.name or self._names.get(metric.alias, ""): metric for metric in payload.metrics[:MOST_METRICS]}
        columns = [self._array(held.get(name), name) for name in self._metrics]
        first = held.get(self._counter) if self._counter else None
        stamps = [held[self._metrics[0]], payload]
        stamp = next((float(holder.timestamp) for holder in stamps if holder.HasField("timestamp")), None)
        return Block(together(columns), None if first is None else _whole(first), stamp)

    def _array(self, metric: Any, name: str) -> NDArray[np.float64]:
        if metric is None or not metric.HasField("bytes_value"):
            raise PayloadError(f"no array {name!r}")
        kind = ARRAYS.get(metric.datatype or self._types.get(name, 0))
        if kind is None or len(metric.bytes_value) % np.dtype(kind).itemsize:
            raise PayloadError(f"{name!r} is no array of numbers")
        with np.errstate(invalid="ignore"):
            return np.frombuffer(metric.bytes_value, kind).astype(np.float64)


class Json:
    """Decodes an object whose members are lists of numbers: {"x": [..], "y": [..], "z": [..]}."""

    def __init__(self, metrics: Sequence[str], counter: str) -> None:
        self._metrics = metrics
        self._counter = counter

    def __call__(self, data: bytes) -> Block:
        """The block of a message. Raises PayloadError."""
        try:
            held = msgspec.json.decode(data)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise PayloadError(str(error)) from None
        if not isinstance(held, dict):
            raise PayloadError("no JSON object")
        columns = [self._list(held.get(name), name) for name in self._metrics]
        counter, stamp = held.get(self._counter) if self._counter else None, held.get("timestamp")
        if isinstance(counter, bool) or not isinstance(counter, int | None):
            raise PayloadError(f"{self._counter!r} is no whole number")
        if isinstance(stamp, bool) or not isinstance(stamp, int | float | None):
            raise PayloadError("'timestamp' is no number")
        return Block(together(columns), counter, None if stamp is None else _float(stamp))

    def _list(self, values: Any, name: str) -> NDArray[np.float64]:
        if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
            raise PayloadError(f"no list of numbers {name!r}")
        return np.array([_float(value) for value in values], np.float64)


def together(columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """One array (n, axes) of the axes (n,). Raises PayloadError where they do not fit or hold what is no indication."""
    if len({len(column) for column in columns}) != 1 or not len(columns[0]):
        raise PayloadError("the axes have different numbers of samples, or none")
    found = np.column_stack(columns)
    if not (np.abs(found) <= LARGEST).all():
        raise PayloadError("a sample that is not a finite number, or too large")
    return found


def _payload(data: bytes) -> Any:
    try:
        return Payload.FromString(data)
    except DecodeError as error:
        raise PayloadError(str(error)) from None


def _whole(metric: Any) -> int:
    kind = metric.WhichOneof("value")
    if kind not in ("int_value", "long_value"):
        raise PayloadError("the counter is no whole number")
    return int(getattr(metric, kind))


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return float("inf")
