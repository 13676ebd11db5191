"""The samples of a sensor and of a reference, from files of any format, also larger than memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.calibrate.faults import as_table_error
from agent.reading.formats import NOT_DESCRIBED, Description, open_source
from agent.reading.ground_motion import GroundMotion
from agent.reading.source import Array, Progress, Source, TableError
from agent.reading.spool import Spool, Spooled
from agent.reading.stationxml import Component
from calib.recorded.choice import Choice, Chosen
from calib.recorded.columns import reference_columns, sensor_columns, si_of
from calib.recorded.output_unit import common
from calib.recorded.table import (
    ReferenceTable,
    SensorTable,
    check_count,
    check_time,
    make_whole,
    second_of,
)
from calib.recorded.units import Sensitivity, unit_name, unit_of


@dataclass(frozen=True, slots=True, eq=False)
class SensorFile(SensorTable):
    """The samples of a sensor's file. `components`: what the metadata of a station say of the three outputs; empty
    where there are none. `filters`: the known filters that its driver states in a recording of `fieldcal run`."""

    components: tuple[Component, ...] = ()
    filters: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFile(ReferenceTable):
    """The samples of a reference's file. `components` and `filters` as those of a sensor."""

    components: tuple[Component, ...] = ()
    filters: tuple[str, ...] = ()


def read_sensor(
    path: Path, progress: Progress | None = None, columns: str | None = None, described: Description = NOT_DESCRIBED
) -> SensorFile:
    """Read the samples of a sensor, in the unit of the file. Raises TableError.

    `columns` is the option --columns.
    """
    with as_table_error(), open_source(path, described, "sensor") as source:
        choice = Choice(source, columns, "--columns")
        chosen = choice.in_one_group(sensor_columns)
        times, values = _rows(source, chosen, progress, np.ones(len(chosen) - 1))
        unit = common([unit_name(c.unit) for c in chosen[1:4]])
        said, components = _described(source, choice, chosen[1:4])
        filters = source.filters.get(chosen[1].column.group, ())
    temperature_degc = Spooled(values, 3) if len(chosen) > 4 else None
    channels = Spooled(values, slice(0, 3))
    return SensorFile(str(path), times, channels, temperature_degc, said, unit, components, filters)


def _described(
    source: Source, choice: Choice, chosen: Sequence[Chosen]
) -> tuple[tuple[str, ...], tuple[Component, ...]]:
    """What the user is told, and what the metadata of a station say of the chosen channels."""
    if not isinstance(source, GroundMotion):
        return tuple(choice.said), ()
    return (*source.said, *choice.said), tuple(source.components[c.column] for c in chosen)


def read_reference(
    path: Path,
    progress: Progress | None = None,
    columns: str | None = None,
    sensitivity: Sensitivity | None = None,
    described: Description = NOT_DESCRIBED,
) -> ReferenceFile:
    """Read the samples of a reference in SI units. Raises TableError.

    `columns` is the option --reference-columns, `metadata` a StationXML.
    """
    with as_table_error(), open_source(path, described, "reference") as source:
        choice = Choice(source, columns, "--reference-columns")
        chosen, quantity = choice.in_one_group(lambda choice: reference_columns(choice, sensitivity))
        scale = np.array([si_of(choice, c, sensitivity) for c in chosen[1:]])
        times, values = _rows(source, chosen, progress, scale)
        said, components = _described(source, choice, chosen[1:])
        filters = source.filters.get(chosen[1].column.group, ())
    column, header = str(chosen[1].column), source.header
    channels = Spooled(values, slice(None))
    return ReferenceFile(str(path), times, channels, quantity, column, header, said, components, filters)


def _rows(source: Source, chosen: Sequence[Chosen], progress: Progress | None, scale: Array) -> tuple[Spooled, Spool]:
    """The first of the chosen columns (n,), n >= 2, which are times in s, and the others (n, k) times `scale`; on disk.

    Where one of the channels (columns 1 to 3) has no value, the others have none either.
    """
    whole, time_unit = 0, unit_of(chosen[0].unit) if chosen[0].unit else None
    if time_unit is not None and time_unit.quantity != "time":
        raise TableError(f"{source.path}, {source.header}: column {str(chosen[0].column)!r} is in {chosen[0].unit}, "
                         "which is no unit of time")  # fmt: skip
    second = None if time_unit is None else time_unit.si
    place, names = str(source.path), [c.column.name for c in chosen]
    times, values = Spool(1), Spool(len(chosen) - 1)
    with as_table_error(source.place):
        for rows in source.pieces([c.column for c in chosen], progress):
            if second is None and len(rows):
                second = second_of(float(rows[0, 0]))
            make_whole(rows, names, place, values.rows)
            times.append(rows[:, :1] * (1.0 if second is None else second))
            values.append(rows[:, 1:] * scale)
            whole += int(np.isfinite(rows[:, 1]).sum())
        check_count(whole, place)
        check_time(time_s := Spooled(times, 0), names[0], place)
    return time_s, values
