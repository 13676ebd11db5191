"""The samples of a sensor and of a reference, from files of any format, also larger than memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.calibrate.faults import as_table_error
from agent.calibrate.times import Times
from agent.reading.formats import NOT_DESCRIBED, Description, open_source
from agent.reading.gravity import unit_warning
from agent.reading.ground_motion import GroundMotion
from agent.reading.source import Array, Progress, Source, TableError
from agent.reading.spool import Spool, Spooled
from agent.reading.stationxml import StationChannel
from calib.recorded.choice import Choice, ChosenColumn
from calib.recorded.columns import in_the_first_unit, reference_columns, sensor_columns, si_of
from calib.recorded.table import (
    ReferenceTable,
    SensorTable,
    check_count,
    check_time,
    make_whole,
)
from calib.recorded.units import Sensitivity


@dataclass(frozen=True, slots=True, eq=False)
class SensorFile(SensorTable):
    """The samples of a sensor's file. `components`: what the metadata of a station say of the three outputs; empty
    where there are none. `filters`: the known filters that its driver states in a recording of `fieldcal run`.
    `restart`: where its time begins anew, "" where it does not: then it has the clock of no other file."""

    components: tuple[StationChannel, ...] = ()
    filters: tuple[str, ...] = ()
    restart: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFile(ReferenceTable):
    """The samples of a reference's file. `components` and `filters` as those of a sensor."""

    components: tuple[StationChannel, ...] = ()
    filters: tuple[str, ...] = ()


def read_sensor(
    path: Path, progress: Progress | None = None, columns: str | None = None, described: Description = NOT_DESCRIBED
) -> SensorFile:
    """Read the samples of a sensor, in the unit of the file; where it has several, in that of x. Raises TableError.

    `columns` is the option --columns.
    """
    with as_table_error(), open_source(path, described, "sensor") as source:
        choice = Choice(source, columns, "--columns")
        chosen = choice.in_one_group(sensor_columns)
        unit, scale = in_the_first_unit(choice, chosen[1:4])
        times, values, restart = _rows(source, chosen, progress, np.array([*scale, *[1.0] * len(chosen[4:])]))
        said, components = _described(source, choice, chosen[1:4])
        said += unit_warning(path, "--columns", chosen[:4], Spooled(values, slice(0, 3)))
        filters = source.filters.get(chosen[1].column.group, ())
    temperature_degc = Spooled(values, 3) if len(chosen) > 4 else None
    v = Spooled(values, slice(0, 3))
    return SensorFile(str(path), times, v, temperature_degc, said, unit, components, filters, restart)


def _described(
    source: Source, choice: Choice, chosen: Sequence[ChosenColumn]
) -> tuple[tuple[str, ...], tuple[StationChannel, ...]]:
    """What the user is told, and what the metadata of a station say of the chosen channels."""
    components = source.components if isinstance(source, GroundMotion) else {}
    return (*source.said, *choice.said), tuple(components[c.column] for c in chosen if c.column in components)


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
        times, values, restart = _rows(source, chosen, progress, scale)
        if restart:
            raise TableError(f"{restart}; a reference needs one clock: cut the file there")
        said, components = _described(source, choice, chosen[1:])
        said += unit_warning(path, "--reference-columns", chosen, Spooled(values, slice(None)))
        filters = source.filters.get(chosen[1].column.group, ())
    column, header = str(chosen[1].column), source.header
    channels = Spooled(values, slice(None))
    stated = sensitivity is not None or all(c.unit for c in chosen[1:])
    return ReferenceFile(str(path), times, channels, quantity, column, header, said, stated, components, filters)


def _rows(
    source: Source, chosen: Sequence[ChosenColumn], progress: Progress | None, scale: Array
) -> tuple[Spooled, Spool, str]:
    """The first of the chosen columns (n,), n >= 2, which are times in s, and the others (n, k) times `scale`; on disk.

    Where one of the channels (columns 1 to 3) has no value, the others have none either. A row without a time is left
    out. The third is the place where the time begins anew, "" where it does not.
    """
    whole, clock = 0, Times(source, chosen[0])
    place, names = str(source.path), [c.column.name for c in chosen]
    times, values = Spool(1), Spool(len(chosen) - 1)
    with as_table_error(clock.place):
        for piece in source.pieces([c.column for c in chosen], progress):
            rows = clock.timed(piece)
            make_whole(rows, names, place, values.rows)
            times.append(clock.seconds(rows[:, 0])[:, None])
            values.append(rows[:, 1:] * scale)
            whole += int(np.isfinite(rows[:, 1]).sum())
        check_count(whole, place)
        check_time(time_s := Spooled(times, 0), names[0], place)
    source.said = (*source.said, *clock.messages())
    return time_s, values, clock.restart
