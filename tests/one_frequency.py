"""The paper's bench with motion of one frequency, and with a filter in the sensor: recordings as files, and truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.estimate.nuisances import Priors
from calib.excitation.front_end import Settings
from calib.geometry import clamp
from calib.model import Array
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.signal.instrument import Instrument
from hw.virtual.bench import Bench
from hw.virtual.motion import sine
from hw.virtual.parameters import BenchParameters, SensorParameters
from hw.virtual.schedule import Schedule, clamped

S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
Q_TRUE = np.array([0.36, -0.06, 0.165])
DEGREE = float(np.deg2rad(1.0))
ANGLES = {"angle_rad": 0.2 * DEGREE, "theta_rad": 0.2 * DEGREE, "offset_mps2": 0.05}
EXACT = Priors.none().with_values({"lag_s": 0.02})


def bench(motion_hz: float, **sensor: Any) -> BenchParameters:
    stands = tuple(clamped(35.0, alpha, 2.0) for alpha in (0.0, 30.0, 120.0, 210.0))
    made = SensorParameters(sensitivity=S_TRUE, offset=Q_TRUE, noise_mps2=0.02, **sensor)  # type: ignore[arg-type]
    return BenchParameters(schedule=Schedule(stands, turn_s=1.0), motion=sine(motion_hz, 10.0), sensor=made)


def calibrated(parameters: BenchParameters, seed: int, priors: Priors) -> Outcome:
    recording = Bench(parameters, seed).recording(parameters.schedule.duration_s(3))
    poses = [
        PoseInterval(p.start_s, p.stop_s, clamp(p.theta_deg * DEGREE, p.alpha_deg * DEGREE, position=p.position))
        for p in recording.poses
        if p.theta_deg is not None and p.alpha_deg is not None
    ]
    return adjusted(
        Tables(
            SensorTable("sensor.csv", recording.sensor_stamp_s, recording.v, None),
            ReferenceTable("r.csv", recording.reference_stamp_s, recording.reference, "acceleration", "a"),
            poses,
            Instrument(known=priors.known),
            Making(Settings(bands=True)),
        ),
        priors,
    )


def at_frequency(motion_hz: float, corner_hz: float, order: int) -> Array:
    s = 1j * motion_hz / corner_hz
    h = 1.0 / (1.0 + s) if order == 1 else 1.0 / (1.0 + np.sqrt(2.0) * s + s**2)
    return np.append((abs(h) * S_TRUE).ravel(), Q_TRUE)


def stated(**stated: float) -> Priors:
    return Priors({**EXACT.values, **stated})
