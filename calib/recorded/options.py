"""What a user states for a calibration: the options, with their defaults."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from calib.estimate.quantities import from_deg, from_percent
from calib.model import Array
from calib.recorded.certificate import ReferenceCertificate
from calib.recorded.errors import OptionError
from calib.signal.instrument import QUANTITIES
from calib.signal.known_filters import Highpass, filter_of

Coupling = Literal["dc", "ac"]
CHOICES: Mapping[str, tuple[Any, ...]] = {
    "method": (1, 2, 3),
    "coupling": ("dc", "ac"),
    "reference_coupling": ("dc", "ac"),
    "reference_quantity": tuple(QUANTITIES),
    "static_sign": (1, -1),
}
GRAVITY_MPS2 = (9.7, 9.9)
ABOVE_ZERO = ("nominal", "u_nominal_pct", "reference_frequency_hz")
# By which option each prior is stated, and what converts the unit of the option to that of the prior.
STATED: Mapping[str, tuple[str, Callable[[float], float]]] = {
    "sensor_corner_hz": ("u_sensor_corner_hz", float), "sensor_corner_at_hz": ("sensor_corner_hz", float),
    "theta_rad": ("u_theta_deg", from_deg), "theta_position_rad": ("u_theta_position_deg", from_deg),
    "alpha_common_rad": ("u_alpha_common_deg", from_deg), "angle_rad": ("u_angle_deg", from_deg),
    "gravity_direction_rad": ("u_angle_deg", from_deg), "tilt_rad": ("u_tilt_deg", from_deg),
    "offset_position_mps2": ("u_offset_position_mps2", float), "gravity_mps2": ("u_gravity_mps2", float),
    "reference": ("u_reference_pct", from_percent),
    "reference_transverse": ("u_reference_transverse_pct", from_percent),
    "reference_corner_hz": ("u_reference_corner_hz", float),
    "reference_corner_at_hz": ("reference_corner_hz", float), "rotation_rad": ("u_rotation_deg", from_deg),
    "transverse": ("u_transverse_motion_pct", from_percent), "offset_mps2": ("u_offset_mps2", float),
    "reference_frequency_hz": ("reference_frequency_hz", float),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Options:
    """The options. Raises OptionError if a value is out of its range; `check` tells which do not go together.

    `sensor_filter`, `reference_filter`: the known filters of an instrument, each in one line of text
    (calib.signal.known_filters); empty where nobody states any. `band_hz`: both ends of the band to which sensor and
    reference are limited. `rotation` (3, 3): a = R a_ref. `prior`: S row by row
    and Q (12,), and their covariance (12, 12), see calib.recorded.priors.prior_of. The u of `reference_certificate`
    count in the place of `u_reference_pct` and `u_reference_transverse_pct`.
    """

    method: int = 3
    plain: bool = False
    coupling: Coupling = "dc"
    reference_quantity: str | None = None
    reference_coupling: Coupling | None = None
    rotation: Array | None = None
    gravity: float | None = None  # m/s2
    static_sign: int = 1
    nominal: float | None = None
    u_nominal_pct: float | None = None
    prior: tuple[Array, Array] | None = None
    reference_certificate: ReferenceCertificate | None = None
    reference_frequency_hz: float | None = None
    band_hz: tuple[float, float] | None = None
    sensor_filter: tuple[str, ...] = ()
    reference_filter: tuple[str, ...] = ()
    reference_corner_hz: float = 0.0
    u_reference_corner_hz: float = 0.0
    sensor_corner_hz: float = 0.0
    u_sensor_corner_hz: float = 0.0
    u_angle_deg: float = 0.2
    u_theta_deg: float = 0.2
    u_theta_position_deg: float = 0.0
    u_alpha_common_deg: float = 0.1
    u_offset_mps2: float = 0.05
    u_offset_position_mps2: float = 0.0
    u_reference_pct: float = 0.1
    u_reference_transverse_pct: float = 0.0
    u_transverse_motion_pct: float = 1.0
    u_tilt_deg: float = 0.0
    u_rotation_deg: float = 0.2
    u_gravity_mps2: float | None = None

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise _wrong(name, value, f"choose one of {', '.join(map(repr, choices))}")
        for name in ("sensor_filter", "reference_filter"):
            object.__setattr__(self, name, _lines(getattr(self, name)))
            for line in getattr(self, name):
                _check_filter(name, line)
        if self.rotation is not None and np.shape(self.rotation) != (3, 3):
            raise _wrong("rotation", self.rotation, "give a matrix of 3 x 3 numbers, a = R a_ref")
        if self.band_hz is not None and not _rises(self.band_hz):
            raise _wrong("band_hz", self.band_hz, "give two frequencies in Hz, LOW and HIGH, with 0 <= LOW < HIGH")
        for name in (f.name for f in fields(self) if f.type in ("float", "float | None")):
            value = getattr(self, name)
            if value is not None and (remedy := _out_of_range(name, value)):
                raise _wrong(name, value, remedy)

    def check(self, *, reference: bool, poses: bool, prior: bool) -> None:
        """Check options that need or exclude each other. `reference`, `poses`, `prior`: whether they are given.

        Raises OptionError.
        """
        adjusts = self.method == 3 and not self.plain and reference
        rules = (
            ((self.nominal is None) != (self.u_nominal_pct is None),
             "`nominal` and `u_nominal_pct` must be given together"),
            (self.nominal is not None and prior, "give `nominal` or `prior`, not both"),
            (self.rotation is not None and not reference, "`rotation` needs a tri-axial `reference`"),
            (self.method != 3 and not (reference and poses), f"`method` {self.method} needs `reference` and `poses`"),
            (bool(self.sensor_filter or self.reference_filter) and not adjusts,
             "`sensor_filter` and `reference_filter` are for Method 3 with a `reference`, not `plain`"),
            (self.band_hz is not None and not adjusts, "`band_hz` is for Method 3 with a `reference`, not `plain`"),
            (bool(outside := self._outside_band), outside),
            (self.method != 3 and self.plain, "`plain` is for Method 3 only; remove `plain` or `method`"),
        )  # fmt: skip
        for broken, message in rules:
            if broken:
                raise OptionError(message)

    @property
    def _outside_band(self) -> str:
        """Why the frequency at which S is to hold does not fit the band; "" where it does."""
        at_hz = self.reference_frequency_hz
        if self.band_hz is None or at_hz is None or self.band_hz[0] <= at_hz <= self.band_hz[1]:
            return ""
        return f"`reference_frequency_hz` is {at_hz:g} Hz, outside `band_hz`; state one within it"


def _check_filter(name: str, line: str) -> None:
    """Raise OptionError for a line that states no filter, or a high-pass, which is stated by its corner."""
    try:
        highpass = isinstance(filter_of(line), Highpass)
    except ValueError as error:
        raise OptionError(str(error), column=name, value=line) from None
    if highpass:
        corner = name.replace("filter", "corner_hz")
        raise _wrong(name, line, f"state the corner of an AC-coupled instrument in `{corner}`, `u_{corner}`")


def _lines(given: str | Sequence[str]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(map(str, given))


def _rises(band_hz: Sequence[float]) -> bool:
    return len(band_hz) == 2 and 0.0 <= band_hz[0] < band_hz[1] < math.inf


def _out_of_range(name: str, value: Any) -> str:
    """What to give instead; "" if the value is in range."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)
    if name == "gravity":
        low, high = GRAVITY_MPS2
        return "" if number and low <= value <= high else f"give a number from {low:g} to {high:g} m/s2"
    if name in ABOVE_ZERO:
        return "" if number and value > 0 else "give a number above 0"
    return "" if number and value >= 0 else "give a number from 0 on"


def _wrong(name: str, value: object, remedy: str) -> OptionError:
    return OptionError(f"{value!r} cannot be used", remedy, column=name, value=value)


DEFAULTS = Options()
