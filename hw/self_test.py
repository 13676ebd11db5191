"""What the self-test of a chip must show, and what it showed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from hw.sensor import Sensor

Axes = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SelfTest:
    """Definition of a self-test.

    Writing `before` (register, value), if anything, prepares the device; writing `writes` switches the self-test on.
    `settle_s` after `writes` the indications must have changed by `low_g` to `high_g` (by axis, g). `noise_g` is the
    noise in the data sheet (rms, g) at the present rate and range. `source` names the document of these values.
    The change grows with the supply voltage to the power of `supply_exponent`, by axis. An electrostatic force grows
    with its square; no data sheet but that of the ADXL345 says how much of the supply reaches it, so 2 is the most.
    """

    writes: Sequence[tuple[int, int]]
    settle_s: float
    low_g: Axes
    high_g: Axes
    noise_g: Axes
    source: str
    before: Sequence[tuple[int, int]] = ()
    supply_exponent: Axes = (2.0, 2.0, 2.0)

    @property
    def highest_g(self) -> float:
        """The largest change that passes on any axis, g."""
        return max(map(abs, (*self.low_g, *self.high_g)))


@dataclass(frozen=True, slots=True)
class SelfTestPhase:
    """Half a second with the self-test off, or on: mean and standard deviation of the indications by axis, in g."""

    mean_g: Axes
    scatter_g: Axes
    temperature_degc: float | None


@runtime_checkable
class SelfTestingSensor(Sensor, Protocol):
    """A sensor that can test itself while it is open. Its samples stop meanwhile: it has to be opened again."""

    def begin_self_test(self) -> SelfTest:
        """Prepare the open device, and say what its self-test must show. Raises the same errors as `open`."""

    def self_test_phase(self, *, on: bool) -> SelfTestPhase:
        """Switch the self-test on or off, let it settle, and measure; takes little more than a second.

        Raises the same errors as `read_block`.
        """


@dataclass(frozen=True, slots=True)
class SelfTestReport:
    """Result of a self-test, in g by axis: the change by the self-test, and the noise (rms) without it.

    The noise includes vibration of the device. Noise above the data sheet is therefore no fault; no noise at all is
    one.
    """

    test: SelfTest
    change_g: Axes
    noise_g: Axes

    @property
    def faults(self) -> list[str]:
        """The faults, one line each; empty if the device passed."""
        faults = []
        for i, axis in enumerate("xyz"):
            low, high = self.test.low_g[i], self.test.high_g[i]
            if not low <= self.change_g[i] <= high:
                faults.append(f"{axis} changes by {self.change_g[i]:.3f} g, the limits are {low:g} to {high:g} g")
            if self.noise_g[i] == 0:
                faults.append(f"{axis} has no noise at all: the axis may be dead")
        return faults
