"""Which columns of a table are those of a sensor or of a reference, and what their units are in SI."""

from __future__ import annotations

from calib.recorded.choice import AXES, Choice, Chosen, quantity_of
from calib.recorded.table import REFERENCES, SENSOR
from calib.recorded.units import Sensitivity, unit_of

TEMPERATURE = "temperature_degc"
ELECTRICAL = ("indication", "count")


def sensor_columns(choice: Choice) -> list[Chosen]:
    """Columns of time, x, y, z and, where there is one, temperature. Raises InputError."""
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


def reference_columns(choice: Choice, sensitivity: Sensitivity | None) -> tuple[list[Chosen], str]:
    """Columns of time and of one or three channels, and their quantity. Raises InputError."""
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


def si_of(choice: Choice, chosen: Chosen, sensitivity: Sensitivity | None) -> float:
    """What one unit of the column is in SI units. Raises InputError."""
    unit = unit_of(chosen.unit) if chosen.unit else None
    if sensitivity is None:
        if unit is not None and unit.quantity in ELECTRICAL and not choice.can_be_stated:
            raise choice.fault(
                f"column {str(chosen.column)!r} is in {chosen.unit}, convert it to m/s2, m/s or m: it is"
            )
        if unit is not None and unit.quantity in ELECTRICAL:
            raise choice.fault(f"column {str(chosen.column)!r} is in {chosen.unit}, so `sensitivity` is needed, "
                               "for example `sensitivity` '100 mV/g'")  # fmt: skip
        return 1.0 if unit is None else unit.si
    if unit is not None and unit.quantity not in ELECTRICAL:
        raise choice.fault(f"column {str(chosen.column)!r} is in {chosen.unit} already; remove `sensitivity`")
    if not sensitivity.indication:
        return sensitivity.per / sensitivity.value
    if unit is not None and unit.quantity != sensitivity.indication:
        raise choice.fault(f"`sensitivity` is not for {chosen.unit}, the unit of column {str(chosen.column)!r}")
    return (1.0 if unit is None else unit.si) * sensitivity.per / sensitivity.value
