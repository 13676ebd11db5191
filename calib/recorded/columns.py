"""Which columns of a table are those of a sensor or of a reference, and what their units are in SI."""

from __future__ import annotations

from collections.abc import Sequence

from calib.recorded.choice import AXES, Choice, ChosenColumn, quantity_of
from calib.recorded.errors import InputError
from calib.recorded.table import REFERENCES, SENSOR
from calib.recorded.units import Sensitivity, Unit, unit_of, unknown_unit

TEMPERATURE = "temperature_degc"
ELECTRICAL = ("indication", "count")
QUANTITIES = {"a": "acceleration", "v": "velocity", "d": "displacement"}  # by the letter with which they are stated


def sensor_columns(choice: Choice) -> list[ChosenColumn]:
    """Columns of time, x, y, z and, where there is one, temperature in degC. Raises InputError."""
    if not choice.is_stated and (found := choice.standard(SENSOR)):
        check_units(choice, found[1:], else_si=False)
        return [*found, *(choice.standard([TEMPERATURE]) or [])]
    known = _with_unnamed(choice, _by_role(choice))
    missing = [role for role in ("time", *AXES) if role not in known]
    if missing:
        names = dict(zip(("time", *AXES), SENSOR, strict=True))
        raise choice.fault(f"column {', '.join(names[role] for role in missing)} is missing")
    check_units(choice, [known[axis] for axis in AXES], else_si=False)
    temperature = choice.stated("temperature") or choice.guessed("temperature")
    if temperature and temperature.column.group == known["time"].column.group and _is_in_degc(choice, temperature):
        known["temperature"] = temperature
    if not choice.is_stated:
        choice.say(known)
    return list(known.values())


def _by_role(choice: Choice) -> dict[str, ChosenColumn]:
    """The columns that are stated, or that their names tell."""
    roles = {role: choice.stated(role) or choice.guessed(role) for role in ("time", *AXES)}
    return {role: column for role, column in roles.items() if column}


def _with_unnamed(choice: Choice, known: dict[str, ChosenColumn]) -> dict[str, ChosenColumn]:
    """The same with the columns beside the time, or with all, where only their order tells what they are."""
    rest = choice.rest(list(known.values()))
    if list(known) == ["time"] and len(rest) == len(AXES):
        return known | dict(zip(AXES, choice.in_their_order(rest), strict=True))
    if not known and len(rest) == 4 and choice.unnamed_time():
        return dict(zip(("time", *AXES), rest, strict=True))
    return known


def _is_in_degc(choice: Choice, temperature: ChosenColumn) -> bool:
    """Whether a temperature is in degC, or states no unit. Another one is not taken, which is told."""
    unit = _known_unit(temperature)
    if unit is None or unit.quantity == "temperature":
        return True
    choice.tell(f"the temperature {str(temperature.column)!r} is in {unit.name}, not in degC; it is left out")
    return False


def check_units(choice: Choice, channels: Sequence[ChosenColumn], *, else_si: bool) -> None:
    """Raises InputError where the channels of one device have no quantity in common, or where one has no unit, or an
    unknown one, and those of the others do not tell it. `else_si`: a channel without a unit is in SI."""
    units = [_known_unit(channel) for channel in channels]
    stated = {unit for unit in units if unit}
    unknown = any(unknown_unit(c.column.name, c.unit) for c, unit in zip(channels, units, strict=True) if unit is None)
    none_fits = len(stated) == 1 and not unknown and not (else_si and any(unit.si != 1.0 for unit in stated))
    if len({unit.quantity for unit in stated}) > 1 or (stated and None in units and not none_fits):
        told = ", ".join(f"{str(channel.column)!r} in {_unit_as_stated(channel)}" for channel in channels)
        raise choice.fault(f"the units do not go together, {told},")


def _known_unit(channel: ChosenColumn) -> Unit | None:
    return unit_of(channel.unit) if channel.unit else None


def _unit_as_stated(channel: ChosenColumn) -> str:
    return channel.unit or unknown_unit(channel.column.name, "") or "no unit that is stated"


def in_the_first_unit(choice: Choice, channels: Sequence[ChosenColumn]) -> tuple[str, list[float]]:
    """The unit of the first channel of a sensor, "" where none is known, and what one unit of each channel is in it.

    `channels` are of one quantity. Where they have several units, this is told.
    """
    units = [unit for channel in channels if (unit := _known_unit(channel))]
    if len(units) < len(channels):
        return "", [1.0] * len(channels)
    if len(set(units)) > 1:
        told = ", ".join(f"{str(c.column)!r} in {unit.name}" for c, unit in zip(channels, units, strict=True))
        choice.tell(f"the columns have several units, {told}; all values are converted to {units[0].name}")
    return units[0].name, [unit.si / units[0].si for unit in units]


def reference_columns(choice: Choice, sensitivity: Sensitivity | None) -> tuple[list[ChosenColumn], str]:
    """Columns of time and of one or three channels, and their quantity. Raises InputError."""
    if not choice.is_stated and (standard := _standard_reference(choice)):
        columns, quantity = standard
        check_units(choice, columns[1:], else_si=True)
        return columns, sensitivity.quantity if sensitivity else quantity
    time = choice.stated("time") or choice.guessed("time") or choice.unnamed_time()
    stated_as, channels = _channels(choice, time)
    if not time or len(channels) not in (1, 3):
        raise choice.fault("expected exactly one of time and one channel, or time and x, y and z,")
    check_units(choice, channels, else_si=True)
    told = (sensitivity.quantity if sensitivity else None) or stated_as or quantity_of(channels[0])
    if told is None and len(channels) < 3 and not _is_electrical(channels[0]):
        raise choice.fault(f"neither name nor unit tells what {str(channels[0].column)!r} is, add its unit")
    if not choice.is_stated:
        choice.say({"time": time} | dict(zip(AXES, channels, strict=False)))
    return [time, *channels], told or "acceleration"


def _standard_reference(choice: Choice) -> tuple[list[ChosenColumn], str] | None:
    """The columns of a reference with this program's names, and their quantity; None where there are none."""
    found = {names: choice.standard(("time_s", *names)) for names in REFERENCES}
    there = [(names, columns) for names, columns in found.items() if columns]
    if len(there) > 1:
        raise choice.fault(f"expected exactly one of {' | '.join(','.join(names) for names, _ in there)}")
    return (there[0][1], REFERENCES[there[0][0]]) if there else None


def _channels(choice: Choice, time: ChosenColumn | None) -> tuple[str | None, list[ChosenColumn]]:
    """The quantity that is stated with one channel, and the channels: one, three, or any other number if they are not
    to be told."""
    one = [(quantity, column) for letter, quantity in QUANTITIES.items() if (column := choice.stated(letter))]
    three = [column for axis in AXES if (column := choice.stated(axis))]
    if one:
        return one[0][0], [column for _, column in one] if not three else []
    three = three or [column for axis in AXES if (column := choice.guessed(axis))]
    rest = choice.rest([time]) if time and not three else []
    return None, three or list(choice.in_their_order(rest) if len(rest) == len(AXES) else rest)


def _is_electrical(chosen: ChosenColumn) -> bool:
    unit = _known_unit(chosen)
    return unit is not None and unit.quantity in ELECTRICAL


def si_of(choice: Choice, chosen: ChosenColumn, sensitivity: Sensitivity | None) -> float:
    """What one unit of the column is in SI units. Raises InputError."""
    unit = _known_unit(chosen)
    if sensitivity is None:
        if unit is not None and unit.quantity in ELECTRICAL and not choice.can_be_stated:
            raise choice.fault(
                f"column {str(chosen.column)!r} is in {chosen.unit}, convert it to m/s2, m/s or m: it is"
            )
        if unit is not None and unit.quantity in ELECTRICAL:
            raise InputError(
                f"column {str(chosen.column)!r} is in {chosen.unit}, and its sensitivity is not stated",
                "state it as its certificate does: `sensitivity` '100 mV/g'", place=choice.place,
            )  # fmt: skip
        if unit is None and (unknown := unknown_unit(chosen.column.name, chosen.unit)):
            raise choice.unknown(unknown, str(chosen.column))
        return 1.0 if unit is None else unit.si
    if unit is not None and unit.quantity not in ELECTRICAL:
        raise choice.fault(f"column {str(chosen.column)!r} is in {chosen.unit} already; remove `sensitivity`")
    if not sensitivity.indication:
        return sensitivity.per / sensitivity.value
    if unit is not None and unit.quantity != sensitivity.indication:
        raise choice.fault(f"`sensitivity` is not for {chosen.unit}, the unit of column {str(chosen.column)!r}")
    return (1.0 if unit is None else unit.si) * sensitivity.per / sensitivity.value
