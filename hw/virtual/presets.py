"""The two benches of `fieldcal run` without a configuration: an ADXL355 on the paper's clamp, plain and faulty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from hw.virtual.hand import ByHand
from hw.virtual.motion import multisine
from hw.virtual.noise import NoiseStream, generator
from hw.virtual.parameters import (
    BenchParameters,
    Knocks,
    ReferenceParameters,
    SensorParameters,
    TemperatureSwing,
)
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, Schedule, clamped, resting
from hw.virtual.spread import Spread, drawn
from hw.virtual.timebase import Bursts, Clock

COUNTS_PER_MPS2 = 256_000 / STANDARD_GRAVITY_MPS2  # ADXL355 at 2 g
# Range with 20 bit: 20.08 m/s2. Gravity (8.0 on z, 5.6 on x and y), 6 m/s2 of motion and a shock of 8 m/s2 stay below
# 18.
LARGEST_COUNT = 2**19 - 1
THETA_DEG = 35.0
ALPHAS_DEG = (0.0, 30.0, 120.0, 210.0)
HOLD_S = 10.0
SLOW_HZ = 250.0  # of devices of which a busy computer loses no samples
# Four positions at one inclination, then four at another.
GUIDED_DEG = (
    *((35.0, alpha) for alpha in (0.0, 90.0, 180.0, 270.0)),
    *((55.0, alpha) for alpha in (45.0, 135.0, 225.0, 315.0)),
)
TURN_S = 3.0
START_S = 3.0  # the gateway has opened its devices by then; four positions are complete after 52 s
# 22.5 ug/sqrt(Hz) over a quarter of 1 kHz (ADXL355 data sheet: bandwidth ODR / 4)
ADXL355_NOISE_MPS2 = 22.5e-6 * STANDARD_GRAVITY_MPS2 * 250**0.5


def plain(seed: int) -> BenchParameters:
    """The bench without faults: the sensor's own clock, bursts and noise; no lag, true angles, constant Q.

    S differs from nominal by some per cent and has transverse terms, Q is some tenths of a m/s2 (data sheet: up to 75
    mg). Both, and the phases of the motion, follow from `seed`. The rate of the ADXL355 is off by 0.33 % (measured on
    such parts: 12 s per hour). Reference: uniaxial accelerometer on the slide, 1 kHz, in m/s2, its clock off by 40 ppm.
    """
    random = generator(seed, NoiseStream.PRESET)
    main = np.diag(1 + random.uniform(-0.04, 0.04, 3))
    transverse = random.uniform(-0.015, 0.015, (3, 3)) * (1 - np.eye(3))
    offset = random.uniform(0.1, 0.5, 3) * random.choice([-1.0, 1.0], 3)
    return BenchParameters(
        schedule=Schedule(tuple(clamped(THETA_DEG, alpha, HOLD_S) for alpha in ALPHAS_DEG), TURN_S, START_S),
        motion=multisine(random),
        sensor=SensorParameters(
            sensitivity=COUNTS_PER_MPS2 * (main + transverse),
            offset=COUNTS_PER_MPS2 * offset,
            unit="count",
            nominal_sensitivity=COUNTS_PER_MPS2,
            resolution=1.0,
            limit=LARGEST_COUNT,
            clock=Clock(1000.0, rate_error=3.3e-3, offset_s=0.4e-3, wander=20e-6),
            bursts=Bursts(),
            noise_mps2=ADXL355_NOISE_MPS2,
        ),
        reference=ReferenceParameters(
            noise=0.002,
            resolution=1e-5,
            clock=Clock(1000.0, rate_error=40e-6, offset_s=0.7e-3),
            bursts=Bursts(poll_s=0.01),
        ),
    )


def faulty(seed: int) -> BenchParameters:
    """The bench `plain` with all faults of an ordinary field recording; uncertain values are drawn with `seed`.

    - The sensor lags by 5 ms and its rate is off by 1.3 %.
    - The clamp's angles are known to 0.2 deg (0.1 deg common to all positions).
    - The offset differs by 0.05 m/s2 between positions and changes with 5 K of temperature.
    - Shocks act on the sensor but not on the reference.
    - The reference is known to 0.1 %, and its slide moves 1 % sideways.
    """
    bench = plain(seed)
    spread = Spread(
        angle_deg=0.2,
        theta_deg=0.2,
        alpha_common_deg=0.1,
        offset_position_mps2=0.05,
        reference_pct=0.1,
        transverse_motion_pct=1.0,
    )
    sensor = replace(
        bench.sensor,
        clock=replace(bench.sensor.clock, rate_error=0.013, wander=50e-6),
        lag_s=(0.005, 0.005, 0.005),
        # data sheet: offset 0.15 mg/K, sensitivity 0.01 %/K
        offset_per_k_mps2=(1.5e-3, -1.0e-3, 1.5e-3),
        sensitivity_per_k=1e-4,
    )
    bench = replace(
        bench,
        sensor=sensor,
        knocks=Knocks(rate_hz=0.5, peak_mps2=8.0),
        temperature=TemperatureSwing(swing_k=5.0, period_s=1800.0),
    )
    return drawn(bench, spread, np.random.default_rng([seed, NoiseStream.PRESET]))


def by_hand(kind: Literal["clamp", "triad", "gravity"], seed: int) -> BenchParameters:
    """A bench for `fieldcal bench`, turned by hand, whose errors are drawn with `seed` from what such a bench states.

    - "clamp": theta and each alpha are known to 0.2 deg, the offset differs by 0.05 m/s2 between positions.
    - "triad": the sensor rests beside a calibrated triad; offsets differ by 2.5 mm/s2; a person puts them down within
      5 deg of what was told.
    - "gravity": the sensor rests on the faces of its housing, known to 0.2 deg; offsets differ by 2.5 mm/s2.
    """
    bench = plain(seed)
    random = np.random.default_rng([seed, NoiseStream.PRESET])
    on_clamp = kind == "clamp"
    schedule = ByHand(
        (clamped(THETA_DEG, ALPHAS_DEG[0], np.inf) if on_clamp else resting(np.array([0.0, 0.0, 1.0]), np.inf),),
        turn_s=1.0,
        start_s=1.0,
        seed=seed,
        theta_deg=0.2 * random.normal(),
        alpha_deg=0.2,
        tilt_deg=5.0 if kind == "triad" else 0.2,
    )
    reference = bench.reference
    if kind == "triad":
        reference = replace(reference, rotation=np.eye(3))
    sensor = replace(bench.sensor, offset_by_window_mps2=0.05 if on_clamp else 0.0025)
    return at_rate(replace(bench, schedule=schedule, sensor=sensor, reference=reference), SLOW_HZ)


def at_rate(bench: BenchParameters, rate_hz: float) -> BenchParameters:
    """The bench with a sensor and a reference of another rate."""
    clocks = [replace(device.clock, nominal_rate_hz=rate_hz) for device in (bench.sensor, bench.reference)]
    return replace(
        bench, sensor=replace(bench.sensor, clock=clocks[0]), reference=replace(bench.reference, clock=clocks[1])
    )


def guided(seed: int) -> BenchParameters:
    """The bench `plain` with a second inclination, in the order of `fieldcal bench`; its errors are drawn with `seed`.

    Theta and each alpha are known to 0.2 deg, and the offset differs by 0.05 m/s2 between windows: with one inclination
    the main sensitivities stay uncertain by some tenths of a per cent, however long it takes.
    """
    bench = plain(seed)
    stands = tuple(clamped(theta, alpha, HOLD_S) for theta, alpha in GUIDED_DEG)
    bench = replace(bench, schedule=replace(bench.schedule, stands=stands))
    spread = Spread(angle_deg=0.2, theta_deg=0.2, offset_mps2=0.05)
    return drawn(bench, spread, np.random.default_rng([seed, NoiseStream.PRESET]))


PRESETS: dict[str, Callable[[int], BenchParameters]] = {"plain": plain, "faulty": faulty, "guided": guided}
