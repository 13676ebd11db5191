"""Units of indications that a user can state, and what follows from the unit alone."""

from __future__ import annotations

from typing import Literal

Unit = Literal["count", "m/s2", "g", "m/s", "mV"]
STANDARD_GRAVITY_MPS2 = 9.80665


def tells_sensitivity(unit: Unit) -> bool:
    """Whether the unit is one of acceleration, so that the sensitivity is known."""
    return unit in ("m/s2", "g")


def nominal_sensitivity(unit: Unit) -> float | None:
    """Indication per m/s2 in g. None for the others: m/s2 needs no statement, and nothing is known of the rest."""
    return 1 / STANDARD_GRAVITY_MPS2 if unit == "g" else None


def asked_of_certificate(unit: Unit) -> str:
    """What the certificate of a reference with this unit must state; "" where a sensitivity of 1 may be right."""
    if unit != "g":
        return ""
    return f"it indicates g; state {1 / STANDARD_GRAVITY_MPS2:.9f} (1/{STANDARD_GRAVITY_MPS2}), or its certificate's"
