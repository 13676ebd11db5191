"""The faults of a field recording, each alone and all together: the true bench, and the priors of an estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.estimate.nuisances import Priors
from hw.virtual.motion import multisine
from hw.virtual.parameters import BenchParameters, Knocks, SensorParameters
from hw.virtual.schedule import Schedule, clamped
from hw.virtual.spread import Spread, drawn
from hw.virtual.timebase import Bursts, Clock

THETA_DEG = 35.0
FOUR, SIX = (0.0, 30.0, 120.0, 210.0), (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)
SIX_CYCLES_S = 2.0  # at 3 Hz
REPETITIONS = 3
NOISE_MPS2 = 0.02
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.36, -0.06, 0.165])
ANGLE_DEG, OFFSET_MPS2, LAG_S, CORNER_HZ = 0.2, 0.05, 0.005, 0.16
# Priors where a row has no others: the lag is always unknown, because no clock in the field is known to be synchronous.
FIXED = replace(Priors.none(), lag_s=0.02)  # type: ignore[call-arg]


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table: how to draw a bench, its true priors, and whether the fault can be corrected completely."""

    name: str
    bench: Callable[[np.random.Generator], BenchParameters]
    priors: Priors = FIXED
    mended: bool = False


def _bench(alphas: tuple[float, ...] = FOUR, hold_s: float = SIX_CYCLES_S) -> BenchParameters:
    stands = tuple(clamped(THETA_DEG, alpha, hold_s) for alpha in alphas)
    sensor = SensorParameters(sensitivity=S_TRUE, offset=Q_TRUE, noise_mps2=NOISE_MPS2)
    return BenchParameters(schedule=Schedule(stands, turn_s=1.0), sensor=sensor)


def _sensor(bench: BenchParameters, **changes: object) -> BenchParameters:
    return replace(bench, sensor=replace(bench.sensor, **changes))  # type: ignore[arg-type]


def _bursts(bench: BenchParameters) -> BenchParameters:
    """Rate 1.3 % off nominal; a FIFO of 32 samples that is read when it is full; samples stamped at their arrival."""
    clock = Clock(1000.0, rate_error=0.013, offset_s=0.4e-3)
    reference = replace(bench.reference, clock=Clock(1000.0, offset_s=0.7e-3), bursts=Bursts(poll_s=0.01))
    return replace(_sensor(bench, clock=clock, bursts=Bursts(poll_s=0.032)), reference=reference)


def _spread(bench: BenchParameters, **spread: float) -> Callable[[np.random.Generator], BenchParameters]:
    return lambda random: drawn(bench, Spread(**spread), random)


def _all_together(random: np.random.Generator) -> BenchParameters:
    bench = _sensor(_bursts(_bench()), lag_s=(LAG_S,) * 3)
    bench = replace(bench, knocks=Knocks(rate_hz=0.5))
    return drawn(bench, Spread(angle_deg=ANGLE_DEG, theta_deg=ANGLE_DEG, offset_mps2=OFFSET_MPS2), random)


def _velocity(_: np.random.Generator) -> BenchParameters:
    bench = _bench()
    return replace(bench, reference=replace(bench.reference, quantity="velocity", noise=2e-4))


def _corner(random: np.random.Generator) -> BenchParameters:
    bench = replace(_bench(hold_s=10.0), motion=multisine(random, 0.5, 8.0, lines=12, peak_mps2=10.0))
    corner = abs(CORNER_HZ * (1.0 + 0.2 * random.normal()))
    bench = replace(bench, reference=replace(bench.reference, highpass_hz=corner))
    # The filter has removes the mean, so the mean gives no information about the offset
    return drawn(bench, Spread(offset_mps2=OFFSET_MPS2), random)


def _across(random: np.random.Generator) -> BenchParameters:
    bench = _bench()
    amplitude = bench.motion.amplitude_mps2.copy()
    share = random.normal(size=4) * 0.05
    amplitude[:, 1:] = amplitude[:, :1] * (share[:2] + 1j * share[2:])
    return replace(bench, motion=replace(bench.motion, amplitude_mps2=amplitude))


_DEGREE = float(np.deg2rad(1.0))
_ANGLES = FIXED.with_values({"angle_rad": ANGLE_DEG * _DEGREE, "theta_rad": ANGLE_DEG * _DEGREE})
_ANGLES_AND_OFFSETS = _ANGLES.with_values({"offset_mps2": OFFSET_MPS2})

ROWS = (
    Row("none (white noise 0.02 m/s²)", lambda _: _bench(), mended=True),
    Row("sensor lags by 5 ms", lambda _: _sensor(_bench(), lag_s=(LAG_S,) * 3), mended=True),
    Row("rate 1.3 % off, bursts of 32 stamped on arrival", lambda _: _bursts(_bench()), mended=True),
    Row("knocks that the reference does not see", lambda _: replace(_bench(), knocks=Knocks(rate_hz=0.5)), mended=True),
    Row("velocity reference (0.2 mm/s of noise)", _velocity, mended=True),
    Row("clamp angles known to 0.2°", _spread(_bench(), angle_deg=ANGLE_DEG, theta_deg=ANGLE_DEG), _ANGLES),
    Row("offset differs by 0.05 m/s² between windows", _spread(_bench(), offset_mps2=OFFSET_MPS2),
        FIXED.with_values({"offset_mps2": OFFSET_MPS2})),
    Row("six positions, angles and offsets", _spread(_bench(SIX), angle_deg=ANGLE_DEG, theta_deg=ANGLE_DEG,
                                                      offset_mps2=OFFSET_MPS2), _ANGLES_AND_OFFSETS),
    Row("coloured noise, AR(1) 0.99, 0.02 m/s²",
        lambda _: _sensor(_bench(), noise_mps2=0.002, coloured_noise_mps2=NOISE_MPS2)),
    Row("common alpha off by 0.1°", _spread(_bench(), alpha_common_deg=0.1),
        FIXED.with_values({"alpha_common_rad": 0.1 * _DEGREE})),
    Row("theta by position, 0.1°", _spread(_bench(), theta_position_deg=0.1),
        FIXED.with_values({"theta_position_rad": 0.1 * _DEGREE})),
    Row("offset by position, 0.05 m/s²", _spread(_bench(), offset_position_mps2=OFFSET_MPS2),
        FIXED.with_values({"offset_position_mps2": OFFSET_MPS2})),
    Row("reference AC-coupled at 0.16 Hz ± 20 %, 0.5-8 Hz", _corner,
        FIXED.with_values({"reference_corner_hz": 0.2 * CORNER_HZ, "reference_corner_at_hz": CORNER_HZ,
                           "offset_mps2": OFFSET_MPS2})),
    Row("5 % of motion across, unseen by the reference", _across, FIXED.with_values({"transverse": 0.05})),
    Row("g known to 0.03 m/s²", _spread(_bench(), gravity_mps2=0.03), FIXED.with_values({"gravity_mps2": 0.03})),
    Row("reference known to 0.1 %", _spread(_bench(), reference_pct=0.1), FIXED.with_values({"reference": 1e-3})),
    Row("all together", _all_together, _ANGLES_AND_OFFSETS),
)  # fmt: skip
