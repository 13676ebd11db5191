"""Units and names as the report writes them."""

from __future__ import annotations

ACCELERATION = "m/s²"


def output_unit(stated: str) -> str:
    """Of V and Q; a result does not always say it."""
    return {"m/s2": ACCELERATION, "m/s^2": ACCELERATION, "": "output unit"}.get(stated, stated)


def sensitivity_unit(stated: str) -> str:
    """Of S. An output in m/s² has a dimensionless one (section 3 of the paper)."""
    unit = output_unit(stated)
    return "1" if unit == ACCELERATION else f"{unit}/({ACCELERATION})"


def labelled(quantity: str, unit: str) -> str:
    """`S in mV/(m/s²)`; a dimensionless quantity stands alone."""
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


def said(name: str) -> str:
    """A field's name in words, its suffix as the unit: `rate_hz` is `rate in Hz`. Registers' names stay."""
    if not name.islower():
        return name
    for suffix, unit in _SUFFIXES.items():
        if name.endswith(suffix):
            return f"{name.removesuffix(suffix).replace('_', ' ')} in {unit}"
    return name.replace("_", " ")


def position_name(position: str) -> str:
    """The name of a position, shorter where it is one of the clamp."""
    return position.replace("theta", "θ").replace("alpha", "α").replace(" deg", "°") or "–"
