"""Units as files write them, and what they are in SI."""

from __future__ import annotations

import re
from dataclasses import dataclass

from calib.geometry import STANDARD_GRAVITY_MPS2


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: the quantity, how much of the SI unit (s, m/s2, m/s, m) one of it is, and its name in results."""

    quantity: str
    si: float
    name: str


# The first spelling is the unit's name.
_SPELLINGS = {
    ("time", 1.0): "s sec secs second seconds utc",
    ("time", 1e-3): "ms msec millisecond milliseconds",
    ("time", 1e-6): "µs us usec microsecond microseconds",
    ("time", 1e-9): "ns nsec nanosecond nanoseconds",
    ("time", 60.0): "min mins minutes",
    ("time", 3600.0): "h hr hrs hour hours",
    ("time", 86400.0): "day days",
    ("acceleration", 1.0): "m/s2 m/s^2 m/s**2 m/s/s mps2 ms-2 ms^-2 m·s-2 m.s-2 m*s^-2 m/sec2 m/sec^2",
    ("acceleration", 1e-2): "cm/s2 cm/s^2 gal",
    ("acceleration", 1e-3): "mm/s2 mm/s^2",
    ("acceleration", 1e-5): "mgal",
    ("acceleration", 1e-6): "µm/s2 um/s2 µm/s^2 um/s^2",
    ("acceleration", 1e-9): "nm/s2 nm/s^2",
    ("acceleration", 0.3048): "ft/s2 ft/s^2",
    ("acceleration", 0.0254): "in/s2 in/s^2",
    ("acceleration", STANDARD_GRAVITY_MPS2): "g gn g0 g_n grav g's",
    ("acceleration", 1e-3 * STANDARD_GRAVITY_MPS2): "mg milli-g millig mgn",
    ("acceleration", 1e-6 * STANDARD_GRAVITY_MPS2): "µg ug",
    ("velocity", 1.0): "m/s mps",
    ("velocity", 1e-2): "cm/s",
    ("velocity", 1e-3): "mm/s",
    ("velocity", 1e-6): "µm/s um/s",
    ("velocity", 1e-9): "nm/s",
    ("displacement", 1.0): "m",
    ("displacement", 1e-2): "cm",
    ("displacement", 1e-3): "mm",
    ("displacement", 1e-6): "µm um",
    ("indication", 1e3): "V volt volts",  # of the electrical units the base is 1 mV
    ("indication", 1.0): "mV",
    ("indication", 1e-3): "µV uv",
    ("count", 1.0): "count counts lsb cnt cnts digit digits raw",
    ("temperature", 1.0): "degC °c c celsius deg_c",
    ("temperature, not in degC", 1.0): "K kelvin °f f fahrenheit degf deg_f",
}
UNITS = {name.lower(): Unit(*key, names.split()[0]) for key, names in _SPELLINGS.items() for name in names.split()}
SI_NAMES = {quantity: names.split()[0] for (quantity, si), names in _SPELLINGS.items() if si == 1.0}
# After "_" in a name these are units, not parts of the name: time_ms, ax_g.
SUFFIXES = frozenset(
    [
        "s",
        "ms",
        "us",
        "ns",
        "sec",
        "mps2",
        "ms2",
        "g",
        "mg",
        "ug",
        "mps",
        "mm",
        "um",
        "mv",
        "counts",
        "count",
        "lsb",
        "raw",
        "degc",
    ]
)
_ALSO = {"ms2": "m/s2"}
_PLAIN = str.maketrans("²⁻−⋅\u03bc", "2--·µ", " ")
# What stands in brackets behind a name, or below it, and is no unit: a channel, an axis, how a value was made, a word.
_NO_UNIT = re.compile(
    r"[^a-z%]*|[xyz]|(?:ch|channel|sn|no|nr|ref)\b.*|smp|avg|min|max|std|tot|cal|uncal|no unit|unitless|[a-z]{7,}"
)


def unit_of(text: str) -> Unit | None:
    """The unit that `text` names, None where it names none that is known."""
    plain = text.strip().strip("[]").strip().lower().translate(_PLAIN).replace("(", "").replace(")", "").strip()
    return UNITS.get(_ALSO.get(plain, plain))


def unit_name(text: str) -> str:
    """The name of the unit that `text` names; "" where it names none that is known."""
    unit = unit_of(text)
    return "" if unit is None else unit.name


_BRACKETS = re.compile(r"(?P<base>.*?)[\s_]*[\[(](?P<unit>[^\])]*(?:\([^()]*\))?)[\])]\s*")
_SUFFIX = re.compile(r"(?P<base>.+)[_ ](?P<unit>[A-Za-z0-9]+)")
G_FORCE = re.compile(r"g[ _-]?f(?:orce)?[ _-]?([xyz])", re.IGNORECASE)  # an acceleration in g along an axis: gFx


def split(name: str) -> tuple[str, str]:
    """A name of a column without its unit, and the unit: "Acc X [g]" and "acc_x_g" have the unit g."""
    if (found := _BRACKETS.fullmatch(name)) and unit_of(found["unit"]):
        return found["base"], found["unit"]
    if (found := _SUFFIX.fullmatch(name)) and found["unit"].lower() in SUFFIXES:
        return found["base"], found["unit"]
    return (name, "g") if G_FORCE.fullmatch(name) else (name, "")


def unknown_unit(name: str, unit: str) -> str:
    """What stands in the place of a unit of a column, and is none that is known; else ""."""
    found = _BRACKETS.fullmatch(name)
    told = unit or (found["unit"] if found else "")
    return "" if unit_of(told) or _NO_UNIT.fullmatch(told.strip("[]() ").lower()) else told


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """The sensitivity of an instrument: a reading of `indication` units for each `per` SI units of `quantity`."""

    value: float
    indication: str
    quantity: str
    per: float


def sensitivity_of(text: str) -> Sensitivity:
    """ "100 mV/g", "28.8 V/(m/s)"; a number alone is in the unit of the column, for 1 m/s2. Raises ValueError."""
    found = re.fullmatch(r"\s*([-+.\deE]+)\s*(?:([^\s\d/(]+)\s*/\s*(\S.*))?", text)
    value = float(found[1]) if found else 0.0
    if not found or not 0.0 < abs(value) < 1e15:
        point = ", with a point as the decimal mark" if "," in text else ""
        raise ValueError(f"{text!r} is not a sensitivity; write it as 100 mV/g or 10.2 mV/(m/s2){point}")
    if not found[2]:
        return Sensitivity(value, "", "acceleration", 1.0)
    indication, per = unit_of(found[2]), unit_of(found[3])
    if not indication or indication.quantity not in ("indication", "count"):
        raise ValueError(f"{found[2]!r} in {text!r} is none of V, mV, counts")
    if not per or per.quantity not in ("acceleration", "velocity", "displacement"):
        raise ValueError(f"{found[3]!r} in {text!r} is none of g, m/s2, m/s, m")
    return Sensitivity(value * indication.si, indication.quantity, per.quantity, per.si)
