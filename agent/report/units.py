"""Units as the report writes them."""

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
