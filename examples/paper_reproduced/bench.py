"""The paper's bench: slide, clamp, mountings and two accelerometers, with the faults of a real bench."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib.estimate.nuisances import Priors
from calib.geometry import STANDARD_GRAVITY_MPS2, clamp, on_axis
from calib.model import Pose
from calib.paper.amplitudes import SineRun
from hw.virtual.bench import Bench
from hw.virtual.motion import sine
from hw.virtual.parameters import BenchParameters, ClampErrors, ReferenceParameters, SensorParameters
from hw.virtual.schedule import Schedule, Stand, clamped, directed, rotation
from hw.virtual.timebase import Clock

Array = NDArray[np.float64]

THETA_DEG = 35.0
METHOD_2_ALPHA_DEG = 135.0
CYCLES = 6
TURN_S = 0.8  # the slide's motion fades out and in
LDV_NOISE_MPS = 2e-5
# The sensor lies on the table with z into it. For z along the motion it stands on its side.
TABLE_GRAVITY = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """An accelerometer of section 2.5, with S and Q similar to those in the paper. S in `unit` per m/s2."""

    key: str
    name: str
    unit: str
    nominal: float
    sensitivity: Array
    offset: Array
    noise_mps2: float
    dc: bool
    # Four of 0, 30, 90, 120, 135, 210; the paper does not say which four it used for which sensor
    alphas_deg: tuple[float, ...]
    transverse_limit_pct: float  # section 3.1.5, 3.2.5: the limit that Method 1 had verified


def _rows(main: tuple[float, ...], relative_pct: list[list[float]]) -> Array:
    return np.array(main)[:, None] * (np.eye(3) + np.array(relative_pct) / 100)


# The white noise gives s_rel of 0.03 % in Method 1 at 10 m/s2 (3.1.1, 3.2.1). Q is that at 3 Hz (3.1.3, 3.2.3). The
# transverse sensitivities are within the paper's limits (3.1.5, 3.2.5). Method 2 neglects them, and they are chosen so
# that Method 2 differs from Method 1 as in Tables 3 and 4.
PIEZO = Device(
    key="piezo",
    name="piezo-electric PCB 356A15",
    unit="mV",
    nominal=10.0,
    sensitivity=_rows((10.12, 9.95, 10.31), [[0, -0.92, 0.4], [-0.5, 0, 0.76], [-0.95, 1.0, 0]]),
    offset=np.array([0.3113, 0.5427, 0.06098]),  # offset of the data acquisition, because the sensor is AC-coupled
    noise_mps2=0.015,
    dc=False,
    alphas_deg=(0.0, 90.0, 135.0, 210.0),
    transverse_limit_pct=3.0,
)
MEMS = Device(
    key="mems",
    name="MEMS Sequoia FastTracer",
    unit="m/s²",
    nominal=1.0,
    sensitivity=_rows((1.011, 0.994, 1.006), [[0, -1.5, 0.8], [1.2, 0, 1.03], [2.0, 1.96, 0]]),
    offset=np.array([0.3576, -0.06304, 0.1650]),
    noise_mps2=0.015,
    dc=True,
    alphas_deg=(0.0, 30.0, 120.0, 210.0),
    transverse_limit_pct=4.0,
)
DEVICES = (PIEZO, MEMS)


@dataclass(frozen=True, slots=True, eq=False)
class Faults:
    """True deviations of a bench, which are unknown to the methods. Angles are true minus nominal.

    Lists by position have the position of Method 2 on the clamp first, then the four positions of Method 3.
    """

    theta_rad: float = 0.0
    alpha_rad: float = 0.0
    alpha_by_position_rad: Array = field(default_factory=lambda: np.zeros(5))
    # Method 1: rotation vector of the sensor for each axis
    mounting_rad: Array = field(default_factory=lambda: np.zeros((3, 3)))
    offset_mps2: Array = field(default_factory=lambda: np.zeros((5, 3)))  # one offset per position of the clamp
    reference: float = 0.0
    lateral: float = 0.0
    vertical: float = 0.0
    gravity_mps2: float = 0.0
    lag_s: float = 0.0
    corner_hz: float = 0.0


def drawn(priors: Priors, random: np.random.Generator) -> Faults:
    """Draw one bench from the distributions that `priors` states."""
    return Faults(
        theta_rad=priors.theta_rad * random.normal(),
        alpha_rad=priors.alpha_common_rad * random.normal(),
        alpha_by_position_rad=priors.angle_rad * random.normal(size=5),
        mounting_rad=priors.angle_rad * random.normal(size=(3, 3)) + priors.alpha_common_rad * random.normal(size=3),
        offset_mps2=priors.offset_mps2 * random.normal(size=(5, 3)),
        reference=priors.reference * random.normal(),
        lateral=priors.transverse * random.normal(),
        vertical=priors.transverse * random.normal(),
        gravity_mps2=priors.gravity_mps2 * random.normal(),
        lag_s=priors.lag_s * random.normal(),
        corner_hz=abs(priors.sensor_corner_hz * random.normal()),
    )


def poses(device: Device) -> dict[str, Pose]:
    """Nominal poses by name: x, y, z of Method 1, then those on the clamp: one of Method 2, four of Method 3."""
    g = STANDARD_GRAVITY_MPS2
    found = [on_axis(axis, g * down, f"axis {axis}") for axis, down in zip("xyz", TABLE_GRAVITY, strict=True)]
    felt = g if device.dc else 0.0
    for method, alpha in [(2, METHOD_2_ALPHA_DEG), *((3, alpha) for alpha in device.alphas_deg)]:
        position = f"method {method}, {alpha:g} deg"
        found.append(clamp(np.deg2rad(THETA_DEG), np.deg2rad(alpha), felt, position=position))
    return {pose.position: pose for pose in found}


def record(
    device: Device,
    faults: Faults,
    frequency_hz: float,
    amplitude_mps2: float,
    seed: int,
    repetitions: int = 3,
    rate_hz: float = 1000.0,
) -> list[SineRun]:
    """Record all runs: the positions in order, `repetitions` times, six cycles each, with an LDV as the reference."""
    hold_s = CYCLES / frequency_hz + 2 / rate_hz
    stands = _stands(device, faults, hold_s)
    none = np.zeros(3)
    parameters = BenchParameters(
        schedule=Schedule(stands, TURN_S),
        motion=sine(frequency_hz, amplitude_mps2).with_transverse(faults.lateral, faults.vertical),
        sensor=_sensor(device, faults, rate_hz),
        reference=ReferenceParameters(
            quantity="velocity",
            sensitivity=1 + faults.reference,
            noise=LDV_NOISE_MPS,
            clock=Clock(rate_hz),
        ),
        gravity_mps2=STANDARD_GRAVITY_MPS2 + faults.gravity_mps2,
        clamp=ClampErrors(
            theta_by_position_deg=tuple(np.rad2deg(np.append(none, np.full(5, faults.theta_rad)))),
            alpha_by_position_deg=tuple(np.rad2deg(np.append(none, faults.alpha_rad + faults.alpha_by_position_rad))),
        ),
    )
    recording = Bench(parameters, seed).recording(parameters.schedule.duration_s(repetitions))
    nominal = list(poses(device).values())
    time = recording.sensor_time_s
    runs = []
    for k, interval in enumerate(recording.poses):
        part = slice(*np.searchsorted(time, (interval.start_s, interval.stop_s)))
        reference, v = recording.reference[part, 0], recording.v[part]
        runs.append(SineRun(time[part], reference, v, nominal[k % len(nominal)], "velocity"))
    return runs


def _stands(device: Device, faults: Faults, hold_s: float) -> tuple[Stand, ...]:
    stands = []
    for axis, (down, turn) in enumerate(zip(TABLE_GRAVITY, faults.mounting_rad, strict=True)):
        angle = float(np.linalg.norm(turn))
        mounted = rotation(turn / angle, angle) if angle else np.eye(3)
        stands.append(directed(mounted @ np.eye(3)[axis], mounted @ down, hold_s))
    return (*stands, *(clamped(THETA_DEG, a, hold_s) for a in (METHOD_2_ALPHA_DEG, *device.alphas_deg)))


def _sensor(device: Device, faults: Faults, rate_hz: float) -> SensorParameters:
    sensor = SensorParameters(
        sensitivity=device.sensitivity,
        offset=device.offset,
        unit=device.unit,
        nominal_sensitivity=device.nominal,
        clock=Clock(rate_hz),
        noise_mps2=device.noise_mps2,
        lag_s=(faults.lag_s,) * 3,
        offset_by_position_mps2=np.vstack([np.zeros((3, 3)), faults.offset_mps2]),
        highpass_hz=faults.corner_hz or None,
    )
    if not device.dc and not faults.corner_hz:
        # AC-coupled with a very low corner frequency: removes gravity and does not change the motion
        return replace(sensor, highpass_hz=1e-9)
    return sensor
