"""All parameters of the virtual bench. Faults are off by default. The values are true values, not priors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hw.virtual.motion import Motion, sine
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, Schedule, clamped
from hw.virtual.timebase import Bursts, Clock

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SensorParameters:
    """The accelerometer under calibration: V = S a + Q (Eq. 8), and its deviations from this model.

    `sensitivity` (3, 3) in output unit per m/s2, `offset` (3,) in output unit. Values in m/s2 are converted to the
    output unit by `nominal_sensitivity`. The filters act on all axes alike; `lag_s` is a pure delay, one value per
    axis. `response` is that of a chip's own filters, over frequency in Hz.
    """

    sensitivity: Array = field(default_factory=lambda: np.eye(3))
    offset: Array = field(default_factory=lambda: np.zeros(3))
    unit: str = "m/s2"
    nominal_sensitivity: float = 1.0
    resolution: float = 0.0  # output unit; 0: not quantised
    limit: float = np.inf  # output unit; indications are limited to +- limit
    clock: Clock = field(default_factory=Clock)
    bursts: Bursts | None = None  # None: every sample is stamped with its true time
    noise_mps2: float = 0.0  # SD of white noise
    coloured_noise_mps2: float = 0.0  # SD of AR(1) noise
    coloured_phi: float = 0.99
    lag_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lowpass_hz: float | None = None
    lowpass_order: Literal[1, 2] = 1
    highpass_hz: float | None = None  # corner of a first-order AC coupling; the sensor then does not indicate gravity
    response: Response | None = None
    offset_by_position_mps2: Array | None = None  # (positions, 3)
    offset_by_window_mps2: float = 0.0  # standard deviation of an offset that changes with every window, per axis
    offset_per_k_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensitivity_per_k: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceParameters:
    """The reference: uniaxial on the slide, or tri-axial beside the sensor if `rotation` is given.

    `rotation` (3, 3) is R in a = R a_ref. `sensitivity` multiplies the indication: with 1.001 it is 0.1 % too high,
    with -1 the polarity is wrong. Noise and resolution are in the reference's unit, m/s2 or m/s.
    """

    rotation: Array | None = None
    quantity: Literal["acceleration", "velocity"] = "acceleration"
    feels_gravity: bool = True  # for a tri-axial reference; gravity has no component along a level slide
    sensitivity: float = 1.0
    noise: float = 0.0
    resolution: float = 0.0
    clock: Clock = field(default_factory=Clock)
    bursts: Bursts | None = None
    lag_s: float = 0.0
    highpass_hz: float | None = None

    @property
    def channels(self) -> Literal[1, 3]:
        """Number of channels."""
        return 1 if self.rotation is None else 3


@dataclass(frozen=True, slots=True)
class ClampErrors:
    """True minus nominal angle of the clamp, in degrees. The lists have one entry per position."""

    theta_deg: float = 0.0
    alpha_deg: float = 0.0
    theta_by_position_deg: tuple[float, ...] = ()
    alpha_by_position_deg: tuple[float, ...] = ()

    def of_positions(self, n: int) -> tuple[Array, Array]:
        """Errors of theta and alpha, in degrees, each (n,). Raises ValueError if a list does not have n entries."""
        theta = np.array(self.theta_by_position_deg or (0.0,) * n)
        alpha = np.array(self.alpha_by_position_deg or (0.0,) * n)
        if theta.shape != (n,) or alpha.shape != (n,):
            raise ValueError(f"angle errors by position: {len(theta)} and {len(alpha)} given for {n} positions")
        return self.theta_deg + theta, self.alpha_deg + alpha


@dataclass(frozen=True, slots=True)
class Slip:
    """The clamp slips by these angles at `at_s`, s of the bench's clock, and stays so until it is turned next."""

    at_s: float
    theta_deg: float = 0.0
    alpha_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Knocks:
    """Shocks at the sensor that the reference does not measure: half-sines at random times in random directions."""

    rate_hz: float = 0.0  # mean number per second
    peak_mps2: float = 8.0  # largest peak; each shock has 0.3 to 1 of it
    duration_s: float = 0.02


@dataclass(frozen=True, slots=True)
class TemperatureSwing:
    """Slow change of the sensor's temperature, mean + swing * sin; the sensor's S and Q hold at `mean_degc`."""

    mean_degc: float = 25.0
    swing_k: float = 0.0
    period_s: float = 1800.0

    def at(self, t_s: Array) -> Array:
        """Temperature at times `t_s`, degC."""
        return np.asarray(self.mean_degc + self.swing_k * np.sin(2 * np.pi * t_s / self.period_s))


@dataclass(frozen=True, slots=True, eq=False)
class BenchParameters:
    """Parameters of the whole bench.

    Default: that of the paper, 3 Hz sine of 10 m/s2, theta 35 deg, six cycles a position, no fault.
    """

    schedule: Schedule = field(
        default_factory=lambda: Schedule(
            tuple(clamped(35.0, alpha, hold_s=2.0) for alpha in (0.0, 30.0, 120.0, 210.0)), turn_s=1.0
        )
    )
    motion: Motion = field(default_factory=lambda: sine(3.0, 10.0))
    sensor: SensorParameters = field(default_factory=SensorParameters)
    reference: ReferenceParameters = field(default_factory=ReferenceParameters)
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    static_sign: Literal[-1, 1] = 1  # -1: z of the sensor points out of the clamp; at rest the sensor indicates -e
    clamp: ClampErrors = field(default_factory=ClampErrors)
    knocks: Knocks = field(default_factory=Knocks)
    slip: Slip | None = None
    temperature: TemperatureSwing = field(default_factory=TemperatureSwing)
    handling_mps2: float = 0.5  # amplitude of the vibration while a person turns the clamp
