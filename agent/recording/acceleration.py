"""Blocks of the corrected stream as protobuf messages. Arrays are copied as bytes, as in agent.recording.raw_block."""

from __future__ import annotations

import numpy as np

from agent.core.events import Acceleration
from agent.proto import fieldcal_pb2 as pb


def encode_acceleration(event_sequence: int, block: Acceleration) -> bytes:
    """Encode a block as protobuf wire bytes."""
    columns = np.ascontiguousarray(block.acceleration.T, "<f8")
    message = pb.AccelerationBytes(
        event_sequence=event_sequence, sensor=block.sensor, t_utc_ns=block.t_utc_ns, first_index=block.first_index,
        rate_hz=block.rate_hz, x=columns[0].tobytes(), y=columns[1].tobytes(), z=columns[2].tobytes(),
        covariance=np.ascontiguousarray(block.covariance, "<f8").tobytes(), noise=block.noise.astype("<f8").tobytes(),
        determined=block.determined.tolist(), calibration_run_id=block.calibration_run_id,
        calibration_sequence=block.calibration_sequence, dynamic_only=block.dynamic_only,
        suspect=block.suspect.tolist() if block.suspect.any() else [],
    )  # fmt: skip
    return message.SerializeToString(deterministic=True)


def decode_acceleration(data: bytes) -> tuple[int, Acceleration]:
    """Decode wire bytes into (event_sequence, block). Raises ValueError or protobuf's DecodeError for invalid bytes."""
    m = pb.AccelerationBytes.FromString(data)
    columns = [np.frombuffer(part, "<f8") for part in (m.x, m.y, m.z)]
    covariance, noise = np.frombuffer(m.covariance, "<f8"), np.frombuffer(m.noise, "<f8")
    if (
        len({len(c) for c in columns}) != 1
        or len(covariance) != 9
        or len(noise) != 3
        or len(m.determined) != 12
        or len(m.suspect) not in (0, 3)
    ):
        raise ValueError(f"x has {len(columns[0])} samples; another axis or an uncertainty has an unexpected length")
    return m.event_sequence, Acceleration(
        sensor=m.sensor, t_utc_ns=m.t_utc_ns, first_index=m.first_index, rate_hz=m.rate_hz,
        acceleration=np.column_stack(columns), covariance=covariance.reshape(3, 3), noise=noise,
        determined=np.array(m.determined, dtype=bool), calibration_run_id=m.calibration_run_id,
        calibration_sequence=m.calibration_sequence, dynamic_only=m.dynamic_only, recorded=True,
        suspect=np.array(m.suspect or [False] * 3, dtype=bool),
    )  # fmt: skip
