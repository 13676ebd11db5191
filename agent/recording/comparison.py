"""Do results that were recorded equal those computed again? Exactly, or within what another CPU may do."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from agent.core.events import Acceleration, Output, WindowReport
from agent.recording.messages import topic_of

OTHER_CPU = (
    1e-9  # relative; kernels of two CPUs differ by 7e-16 a solve, a condition number of 1.2e4 and recursion on top
)
FLOOR = 1e-12  # in the value's own unit: what is left where numbers of order one cancel
THRESHOLD = "_threshold"  # numbers["x"] was held against numbers["x_threshold"]


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """Where recorded and computed results part. `undecidable`: a decision so close that another CPU may turn it.

    How close it is, is computed here; the statistic that was recorded must be the same one.
    """

    file: str
    event_sequence: int
    what: str  # topic, or "snapshot"
    field: str
    recorded: str
    computed: str
    undecidable: bool = False

    def __str__(self) -> str:
        place = f"event {self.event_sequence}, {self.what}, {self.field}"
        return f"{place}: recorded {self.recorded}, computed {self.computed}"


def compare(
    file: str,
    event_sequence: int,
    recorded: Sequence[Output],
    computed: Sequence[Output],
    tolerance: float,
    *,
    complete: bool = True,
) -> Difference | None:
    """The first difference between the results of one event, or None.

    `tolerance` 0 compares floats by their bits, so that NaN equals NaN and 0.0 differs from -0.0; above it is relative
    to the largest of a list. Where `complete` is false the recording may end before the last results.
    """

    def difference(what: str, field: str, before: Any, now: Any, *, decision: bool) -> Difference:
        return Difference(
            file=file,
            event_sequence=event_sequence,
            what=what,
            field=field,
            recorded=_short(before),
            computed=_short(now),
            undecidable=decision and tolerance > 0 and _on_the_edge(recorded, computed),
        )

    for before, now in zip(recorded, computed, strict=False):
        if type(before) is not type(now) or topic_of(before) != topic_of(now):
            return difference(topic_of(before), "kind", topic_of(before), topic_of(now), decision=True)
        for field, a, b in differences(plain(before), plain(now), tolerance):
            return difference(topic_of(before), field, a, b, decision=not isinstance(a, float))
    if len(recorded) > len(computed) or (complete and len(recorded) < len(computed)):
        kinds = ([topic_of(result) for result in results] for results in (recorded, computed))
        return difference("results", "count", *kinds, decision=True)
    return None


def _largest(values: Iterable[Any]) -> float:
    """The largest absolute value among the finite numbers; 0 without any."""
    return max((abs(x) for x in values if isinstance(x, float) and math.isfinite(x)), default=0.0)


def differences(
    a: Any, b: Any, tolerance: float, where: str = "", scale: float = 0.0
) -> Iterator[tuple[str, Any, Any]]:
    """(field, a, b) of every place where two nests of dict, list and plain values differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in sorted(a.keys() | b.keys()):
            inside = f"{where}.{name}" if where else name
            yield from differences(a.get(name), b.get(name), tolerance, inside)
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        scale = _largest((*a, *b))
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from differences(x, y, tolerance, f"{where}[{i}]", scale)
    elif isinstance(a, float) and isinstance(b, float):
        if not _equal(a, b, tolerance, scale):
            yield where, a, b
    elif type(a) is not type(b) or a != b:
        yield where, a, b


def _equal(a: float, b: float, tolerance: float, scale: float) -> bool:
    if struct.pack("<d", a) == struct.pack("<d", b):
        return True
    if tolerance == 0 or not (math.isfinite(a) and math.isfinite(b)):
        return tolerance > 0 and math.isnan(a) and math.isnan(b)
    return abs(a - b) <= max(tolerance * max(abs(a), abs(b), scale), FLOOR)


def _on_the_edge(recorded: Sequence[Output], computed: Sequence[Output]) -> bool:
    """Whether a computed statistic lies within OTHER_CPU of the computed threshold that it was held against.

    The recording is not believed: a window of it with another statistic or threshold is no decision on the edge.
    """
    windows = [result for result in recorded if isinstance(result, WindowReport)]
    for result in computed:
        if isinstance(result, WindowReport):
            names = [name for name in result.numbers if name.endswith(THRESHOLD) and _close(result.numbers, name)]
            before = [w for w in windows if (w.sensor, w.sequence) == (result.sensor, result.sequence)]
            for name in names:
                pair = (name, name.removesuffix(THRESHOLD))
                if all(_agree(w.numbers, result.numbers, pair) for w in before):
                    return True
    return False


def _close(numbers: Mapping[str, float], threshold: str) -> bool:
    statistic, level = numbers.get(threshold.removesuffix(THRESHOLD)), numbers[threshold]
    if statistic is None or (float(statistic).is_integer() and float(level).is_integer()):
        return False  # a count, which is not rounded: 0 clipped points of 0 are in every window
    return abs(statistic - level) <= OTHER_CPU * abs(level)


def _agree(recorded: Mapping[str, float], computed: Mapping[str, float], names: Sequence[str]) -> bool:
    return all(name in recorded and _equal(recorded[name], computed[name], OTHER_CPU, 0.0) for name in names)


def empty_fields(item: Output) -> set[str]:
    """Names of the fields of a result that have their default values."""
    fields = msgspec.structs.fields(item) if isinstance(item, msgspec.Struct) else ()
    defaults = {f.name: f.default if f.default_factory is msgspec.NODEFAULT else f.default_factory() for f in fields}
    return {name for name, default in defaults.items() if getattr(item, name) == default}


def plain(item: Output) -> Any:
    """A result as a dict of builtin values."""
    if isinstance(item, Acceleration):
        fields = {f.name: getattr(item, f.name) for f in dataclasses.fields(item)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in fields.items()}
    return msgspec.to_builtins(item)


def _short(value: Any) -> str:
    text = value.hex() + f" ({value!r})" if isinstance(value, float) else repr(value)
    return text if len(text) <= 200 else text[:197] + "..."
