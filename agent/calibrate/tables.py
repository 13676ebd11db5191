"""The samples of a sensor and of a reference, from files of any format, also larger than memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.calibrate.faults import as_table_error
from agent.reading.choice import AXES, Choice, Chosen, quantity_of
from agent.reading.formats import NOT_DESCRIBED, Description, open_source
from agent.reading.ground_motion import GroundMotion
from agent.reading.source import Array, Progress, Source, TableError
from agent.reading.spool import Spool, Spooled
from agent.reading.stationxml import Component
from agent.reading.units import Sensitivity, unit_name, unit_of
from calib.recorded.output_unit import common
from calib.recorded.table import (
    REFERENCES,
    SENSOR,
    ReferenceTable,
    SensorTable,
    check_count,
    check_time,
    make_whole,
    second_of,
)

TEMPERATURE = "temperature_degc"
ELECTRICAL = ("indication", "count")


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
    with open_source(path, described, "sensor") as source:
        choice = Choice(source, columns, "--columns")
        chosen = choice.in_one_group(_sensor_columns)
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


def _sensor_columns(choice: Choice) -> list[Chosen]:
    """Columns of time, x, y, z and, where there is one, temperature."""
    if not choice.is_stated and (found := choice.standard(SENSOR)):
        return [*found, *(choice.standard([TEMPERATURE]) or [])]
    roles = {role: choice.stated(role) or choice.guessed(role) for role in ("time", *AXES)}
    known = {role: column for role, column in roles.items() if column}
    rest = choice.rest(list(known.values()))
    if "time" in known and len(known) == 1 and len(rest) == len(AXES):
        known |= dict(zip(AXES, rest, strict=True))
    if not known and len(rest) == 4 and all(c.column.name.isdigit() for c in rest):
        known = dict(zip(("time", *AXES), rest, strict=True))
    missing = [role for role in ("time", *AXES) if role not in known]
    if missing:
        names = dict(zip(("time", *AXES), SENSOR, strict=True))
        raise choice.fault(f"column {', '.join(names[role] for role in missing)} is missing")
    temperature = choice.stated("temperature") or choice.guessed("temperature")
    if temperature and temperature.column.group == known["time"].column.group:
        known["temperature"] = temperature
    if not choice.is_stated:
        choice.say(known)
    return list(known.values())


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
    with open_source(path, described, "reference") as source:
        choice = Choice(source, columns, "--reference-columns")
        chosen, quantity = choice.in_one_group(lambda choice: _reference_columns(choice, sensitivity))
        scale = np.array([_si(choice, c, sensitivity) for c in chosen[1:]])
        times, values = _rows(source, chosen, progress, scale)
        said, components = _described(source, choice, chosen[1:])
        filters = source.filters.get(chosen[1].column.group, ())
    column, header = str(chosen[1].column), source.header
    channels = Spooled(values, slice(None))
    return ReferenceFile(str(path), times, channels, quantity, column, header, said, components, filters)


def _reference_columns(choice: Choice, sensitivity: Sensitivity | None) -> tuple[list[Chosen], str]:
    """Columns of time and of one or three channels, and their quantity."""
    if not choice.is_stated:
        found = {names: choice.standard(("time_s", *names)) for names in REFERENCES}
        there = [(names, columns) for names, columns in found.items() if columns]
        if len(there) > 1:
            raise choice.fault(f"expected exactly one of {' | '.join(','.join(names) for names, _ in there)}")
        if there:
            names, columns = there[0]
            return columns or [], sensitivity.quantity if sensitivity else REFERENCES[names]
    time = choice.stated("time") or choice.guessed("time")
    letters = {letter: choice.stated(letter) for letter in "avd"}
    one = [(letter, column) for letter, column in letters.items() if column]
    three = [choice.stated(axis) for axis in AXES]
    if not one and not any(three):
        three = [choice.guessed(axis) for axis in AXES]
    given = [column for column in three if column]
    if not one and not given and time:
        given = choice.rest([time])
    if not time or len(one) + len(given) not in (1, 3) or (one and given):
        raise choice.fault("expected exactly one of time and one channel, or time and x, y and z,")
    channels = [column for _, column in one] or given
    quantity = {"a": "acceleration", "v": "velocity", "d": "displacement"}[one[0][0]] if one else None
    quantity = (sensitivity.quantity if sensitivity else None) or quantity or quantity_of(channels[0])
    if quantity is None and len(channels) == 3:
        quantity = "acceleration"
    if quantity is None and not _is_electrical(channels[0]):
        raise choice.fault(f"neither name nor unit tells what {str(channels[0].column)!r} is, add its unit")
    if not choice.is_stated:
        choice.say({"time": time} | {f"{k}": c for k, c in zip(AXES, channels, strict=False)})
    return [time, *channels], quantity or "acceleration"


def _is_electrical(chosen: Chosen) -> bool:
    unit = unit_of(chosen.unit) if chosen.unit else None
    return unit is not None and unit.quantity in ELECTRICAL


def _si(choice: Choice, chosen: Chosen, sensitivity: Sensitivity | None) -> float:
    """What one unit of the column is in SI units."""
    unit = unit_of(chosen.unit) if chosen.unit else None
    if sensitivity is None:
        if unit is not None and unit.quantity in ELECTRICAL:
            raise choice.fault(f"column {str(chosen.column)!r} is in {chosen.unit}, so --sensitivity is needed, "
                               "for example --sensitivity '100 mV/g'")  # fmt: skip
        return 1.0 if unit is None else unit.si
    if unit is not None and unit.quantity not in ELECTRICAL:
        raise choice.fault(f"column {str(chosen.column)!r} is in {chosen.unit} already; remove --sensitivity")
    if not sensitivity.indication:
        return sensitivity.per / sensitivity.value
    if unit is not None and unit.quantity != sensitivity.indication:
        raise choice.fault(f"--sensitivity is not for {chosen.unit}, the unit of column {str(chosen.column)!r}")
    return (1.0 if unit is None else unit.si) * sensitivity.per / sensitivity.value


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
