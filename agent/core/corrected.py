"""The corrected stream: each block of a sensor, converted to accelerations with the calibration in force."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.config import Channel
from agent.core.events import Acceleration, CalibrationUpdate
from agent.core.stream import DeviceStream
from calib.estimate.correction import Law, corrected
from calib.model import Array
from hw.block import SampleBlock


def accelerations(
    block: SampleBlock,
    stream: DeviceStream,
    origin_utc_ns: int,
    channel: Channel,
    law: Law,
    residual_sd: Array,
    in_force: CalibrationUpdate | None,
    suspect: NDArray[np.bool_],
) -> list[Acceleration]:
    """A block as accelerations in m/s2; empty if the channel has none, the block not three axes, or S no inverse.

    `stream` gives the sample times, `origin_utc_ns` is UTC at its origin. `law`: S and Q over temperature, those of the
    prior if `in_force` is None. `residual_sd` (3,): of single samples, output unit.
    `suspect` (3,): outputs of which samples in the block are wrong.
    """
    if channel.acceleration == "off" or block.indications.shape[1] != 3 or not block.n:
        return []
    degc = float("nan") if block.temperature_degc is None else block.temperature_degc
    try:
        found = corrected(np.asarray(block.indications, dtype=np.float64), law.at(degc), residual_sd)
    except np.linalg.LinAlgError:
        return []
    first_s, rate_hz = stream.taken_at(block.first_index)
    made = Acceleration(
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
        dynamic_only=channel.coupling == "ac",
        suspect=suspect,
        recorded=channel.acceleration == "record",
    )
    return [made]
