"""Tables in long form: a line for each value, whose channel stands in another column. They are not read."""

from __future__ import annotations

from collections.abc import Sequence

from agent.reading.dialect import MISSING, is_number_or_moment

# Names of the columns in which databases and their pages write the value, and the channel.
VALUES = frozenset(("_value", "value", "values", "__value__", "val"))
CHANNELS = frozenset(
    ("_field", "field", "series", "metric", "name", "__name__", "variable", "channel", "signal", "parameter", "sensor",
     "tag", "topic", "measurement")
)  # fmt: skip


def remedy_of(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """What to do with a table in long form; "" for any other one."""
    plain = [name.strip().lower() for name in header]
    channels = [k for k, name in enumerate(plain) if name in CHANNELS and _has_words(rows, k)]
    if not channels or len(VALUES & set(plain)) != 1:
        return ""
    named = header[channels[0]]
    value = next(name for name, low in zip(header, plain, strict=True) if low in VALUES)
    flux = f' (in Flux |> pivot(rowKey: ["_time"], columnKey: ["{named}"], valueColumn: "{value}"))'
    how = flux if named.startswith("_") else ' (in Grafana "Series joined by time"; in pandas `DataFrame.pivot`)'
    return (
        f"each line has one value, in {value!r}, and names its channel in {named!r}: write a line for each time, with "
        f"a column for each channel{how}"
    )


def _has_words(rows: Sequence[Sequence[str]], place: int) -> bool:
    """Whether all cells of a column are words."""
    cells = [row[place] for row in rows]
    return bool(cells) and not any(is_number_or_moment(cell) or cell.lower() in MISSING for cell in cells)
