"""The corrected stream: each block of a sensor, converted to accelerations with the calibration in force."""

from __future__ import annotations

import numpy as np

from agent.core.events import Acceleration, CalibrationUpdate
from agent.core.stream import DeviceStream
from calib.estimate.correction import Law, corrected
from calib.model import Array
from hw.block import SampleBlock


def acceleration_block(
    block: SampleBlock,
    stream: DeviceStream,
    origin_utc_ns: int,
    law: Law,
    residual_sd: Array,
    in_force: CalibrationUpdate | None,
    *,
    dynamic_only: bool,
    recorded: bool,
) -> Acceleration | None:
    """A block as accelerations in m/s2; None if the block does not have three axes or S has no inverse.

    `stream` gives the sample times, `origin_utc_ns` is UTC at its origin. If `in_force` is None, the prior is used.
    """
    if block.indications.shape[1] != 3 or not block.n:
        return None
    degc = float("nan") if block.temperature_degc is None else block.temperature_degc
    calibration = law.at(degc)
    try:
        found = corrected(np.asarray(block.indications, dtype=np.float64), calibration, residual_sd)
    except np.linalg.LinAlgError:
        return None
    first_s, rate_hz = stream.taken_at(block.first_index)
    return Acceleration(
        sensor=block.device,
        t_utc_ns=origin_utc_ns + round(first_s * 1e9),
        first_index=block.first_index,
        rate_hz=rate_hz,
        acceleration=found.acceleration,
        covariance=found.covariance,
        noise=found.noise,
        determined=law.determined,
        calibration_run_id="" if in_force is None else in_force.made[0],
        calibration_sequence=0 if in_force is None else in_force.made[1],
        dynamic_only=dynamic_only,
        recorded=recorded,
    )
