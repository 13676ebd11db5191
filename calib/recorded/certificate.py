"""What the certificate of a reference states."""

from __future__ import annotations

from dataclasses import dataclass

from calib.model import Array
from calib.signal.known_filters import Filter


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceCertificate:
    """What it states. `sensitivity` and its relative standard uncertainty `u_relative`: (1,), or (3,) by channel, as
    indication per SI unit. `u_transverse`: that of its transverse sensitivities, over the main ones. `corner_hz`: of an
    AC-coupled reference, with its u; None where it is not stated.
    `filters`: those that it states, and the table of its calibration over frequency. `path` of the file, with its
    `sha256`; "" without a file."""

    path: str
    sha256: str
    serial_number: str
    sensitivity: Array
    u_relative: Array
    u_transverse: float = 0.0
    corner_hz: tuple[float, float] | None = None
    filters: tuple[Filter, ...] = ()
