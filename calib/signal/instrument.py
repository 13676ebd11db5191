"""What a reference measures, described once: for files and streams alike."""

from __future__ import annotations

from dataclasses import dataclass

from calib.signal.known_response import UNKNOWN, KnownResponse

# How many times each quantity must be differentiated to give an acceleration.
QUANTITIES = {"acceleration": 0, "velocity": 1, "displacement": 2}


@dataclass(frozen=True, slots=True)
class Instrument:
    """A reference as its certificate describes it.

    `quantity` is a key of QUANTITIES. `sensitivity`: indication per unit of that quantity in SI units. `noise` is the
    standard deviation of its own noise over its whole band, in that quantity's SI unit; 0 where nobody stated it: it is
    then found from the data. `corner_hz`, `u_corner_hz`: corner frequency of an AC-coupled reference (first order) and
    its standard uncertainty; both 0 where it responds to constants. `sensor_corner_hz`, `u_sensor_corner_hz`: the same
    of the sensor beside it. `ac_coupled`, `sensor_ac_coupled`: whether the reference and the sensor do not respond to
    constants. `known`: what is stated of the filters of both.
    """

    quantity: str = "acceleration"
    sensitivity: float = 1.0
    noise: float = 0.0
    corner_hz: float = 0.0
    u_corner_hz: float = 0.0
    sensor_corner_hz: float = 0.0
    u_sensor_corner_hz: float = 0.0
    ac_coupled: bool = False
    sensor_ac_coupled: bool = False
    known: KnownResponse = UNKNOWN

    @property
    def derivatives(self) -> int:
        """How many times its indications are differentiated to give an acceleration."""
        return QUANTITIES[self.quantity]

    @property
    def has_corner(self) -> bool:
        """Whether a corner of the reference or of the sensor is stated, or unknown."""
        return any((self.corner_hz, self.u_corner_hz, self.sensor_corner_hz, self.u_sensor_corner_hz))

    @property
    def corner_unknown(self) -> bool:
        """Whether there is a corner that nobody stated: the response below the motion is then an unknown."""
        return (self.ac_coupled or self.sensor_ac_coupled) and not self.has_corner

    @property
    def corners_alike(self) -> bool:
        """Whether neither responds to constants, and nobody stated a corner: nothing tells both apart."""
        return self.corner_unknown and self.ac_coupled and self.sensor_ac_coupled

    @property
    def share_of_corner(self) -> float:
        """The reference's share in what an unknown corner does: all where the sensor responds to constants. Where both
        do not, nothing tells them apart, and all is the sensor's."""
        return 0.0 if self.sensor_ac_coupled else 1.0
