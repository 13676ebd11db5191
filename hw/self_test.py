"""What a chip's self-test must show, and what it did show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Axes = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SelfTest:
    """`writes` (register, value) turn it on; the indications then change by `low_g` to `high_g` after `settle_s`.

    `noise_g` is the data sheet's noise (rms) at this rate and range. `source` says where the figures stand.
    """

    writes: Sequence[tuple[int, int]]
    settle_s: float
    low_g: Axes
    high_g: Axes
    noise_g: Axes
    source: str


@dataclass(frozen=True, slots=True)
class SelfTestReport:
    """What was measured, in g by axis: the change by the self-test, and the noise (rms) without it.

    The noise holds what shakes the device too: more than the data sheet's is no fault of it, none at all is.
    """

    test: SelfTest
    change_g: Axes
    noise_g: Axes

    @property
    def faults(self) -> list[str]:
        """What is not as it should be, one line each; empty: passed."""
        faults = []
        for i, axis in enumerate("xyz"):
            low, high = self.test.low_g[i], self.test.high_g[i]
            if not low <= self.change_g[i] <= high:
                faults.append(f"{axis} changes by {self.change_g[i]:.3f} g, not by {low:g} to {high:g} g")
            if self.noise_g[i] == 0:
                faults.append(f"{axis} has no noise at all: is it dead?")
        return faults
