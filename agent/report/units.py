"""Units and names as the report writes them."""

from __future__ import annotations

from calib.output_unit import ACCELERATION, shown_in, unit_text

_REFERENCES = {
    "acceleration": "reference accelerometer",
    "velocity": "reference vibrometer (velocity)",
    "displacement": "reference displacement sensor",
}


def output_unit(stated: str) -> str:
    """The unit of V; "output unit" if the result does not state it."""
    return unit_text(stated)


def sensitivity_unit(stated: str) -> str:
    """The unit of S as it is shown. If the output is in m/s², S is dimensionless (section 3 of the paper)."""
    return shown_in(stated).sensitivity


def offset_unit(stated: str) -> str:
    """The unit of Q as it is shown: that of V, but mg where V is in g."""
    return shown_in(stated).offset


def reference_name(quantity: object) -> str:
    """What an instrument is called that gives acceleration, velocity or displacement as the reference."""
    return _REFERENCES.get(str(quantity), "reference instrument")


def labelled(quantity: str, unit: str) -> str:
    """`S in mV/(m/s²)`; for a dimensionless quantity only its name."""
    return quantity if unit == "1" else f"{quantity} in {unit}"


_SUFFIXES = {
    "_mps2": ACCELERATION,
    "_hz": "Hz",
    "_s": "s",
    "_ns": "ns",
    "_degc": "°C",
    "_deg": "°",
    "_rad": "rad",
    "_pct": "%",
}


def in_words(name: str) -> str:
    """A field's name in words, its suffix as the unit: `rate_hz` is `rate in Hz`.

    Names of registers are not changed.
    """
    if not name.islower():
        return name
    for suffix, unit in _SUFFIXES.items():
        if name.endswith(suffix):
            return f"{name.removesuffix(suffix).replace('_', ' ')} in {unit}"
    return name.replace("_", " ")


def position_name(position: str) -> str:
    """The name of a position, shortened for positions of the clamp."""
    return position.replace("theta", "θ").replace("alpha", "α").replace(" deg", "°") or "–"
