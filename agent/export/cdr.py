"""Messages of ROS 2 in CDR (little-endian), which plot programs show without a plug-in: Imu and JointState."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

IMU, JOINT_STATE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
_BEGIN = b"\x00\x01\x00\x00"  # CDR, little-endian, no options
_HEADER = """================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
DEFINITIONS = {
    IMU: f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_HEADER}""",
    JOINT_STATE: f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
}
_NOT_MEASURED = (-1.0, *[0.0] * 8)  # the covariance that says so, in the words of ROS


class _CdrWriter:
    """A message that grows; numbers are aligned to their size from the end of the four first bytes."""

    def __init__(self, t_utc_ns: int, frame: str) -> None:
        self._data = bytearray()
        self.put("i", t_utc_ns // 10**9)
        self.put("I", t_utc_ns % 10**9)
        self.text(frame)

    def put(self, kind: str, *values: float) -> None:
        size = struct.calcsize(f"<{kind}")
        self._data += b"\x00" * (-len(self._data) % size)
        self._data += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.put("I", len(encoded))
        self._data += encoded

    def numbers(self, values: Sequence[float]) -> None:
        """A sequence of float64."""
        self.put("I", len(values))
        if values:
            self.put("d", *values)

    def message(self) -> bytes:
        return _BEGIN + bytes(self._data)


def imu(t_utc_ns: int, frame: str, acceleration: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bytes:
    """An acceleration (3,) in m/s2. Orientation and angular velocity are marked as not measured, as ROS does it."""
    cdr = _CdrWriter(t_utc_ns, frame)
    cdr.put("d", 0.0, 0.0, 0.0, 1.0, *_NOT_MEASURED)
    cdr.put("d", 0.0, 0.0, 0.0, *_NOT_MEASURED)
    cdr.put("d", *acceleration.tolist(), *[0.0] * 9)  # covariance 0: not known
    return cdr.message()


def joint_state(t_utc_ns: int, frame: str, names: Sequence[str], values: Sequence[float]) -> bytes:
    """Named numbers, as `position`."""
    cdr = _CdrWriter(t_utc_ns, frame)
    cdr.put("I", len(names))
    for name in names:
        cdr.text(name)
    cdr.numbers(values)
    cdr.numbers([])
    cdr.numbers([])
    return cdr.message()
