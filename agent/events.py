"""What goes into the pipeline (events) and what comes out of it (results). Both are recorded in this form.

All times are the gateway's: `t_monotonic_ns` is CLOCK_MONOTONIC of the boot named by `boot_id`, `t_utc_ns` is UTC.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from hw.block import SampleBlock


class RunStart(msgspec.Struct, frozen=True, kw_only=True):
    """First event of every file: all that replaying it needs. `continuation`: the run goes on from another file."""

    run_id: str
    site: str
    gateway: str
    boot_id: str
    t_monotonic_ns: int
    t_utc_ns: int
    config_json: str
    versions: dict[str, str]
    fingerprint: dict[str, str]
    snapshot: bytes  # Pipeline.snapshot() before the next event
    file_sequence: int
    event_sequence: int  # of this event; the next event has the next number
    continuation: bool = False


class DeviceChange(msgspec.Struct, frozen=True, kw_only=True):
    """A device was lost, came back, or was opened; `info` is its identity as read (JSON of DeviceInfo)."""

    device: str
    state: Literal["open", "lost"]
    t_monotonic_ns: int
    t_utc_ns: int
    message: str = ""
    info_json: str = ""
    attempt: int = 0


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """Something between device and pipeline was dropped: a full queue, unreadable lines, a jump in the sequence."""

    device: str
    t_monotonic_ns: int
    dropped: int
    unit: Literal["samples", "blocks", "lines", "bytes"]
    reason: str


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """Time passes though devices may be silent."""

    t_monotonic_ns: int
    t_utc_ns: int


Event = RunStart | SampleBlock | DeviceChange | Gap | Tick


class WindowReport(msgspec.Struct, frozen=True, kw_only=True):
    """The verdict on one window."""

    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    start_s: float  # since the sensor's first sample
    stop_s: float
    position: str
    used: bool
    reason: str
    points: int
    left_out: int
    numbers: dict[str, float]  # the statistics behind the verdict, each with its unit in its name


class CalibrationUpdate(msgspec.Struct, frozen=True, kw_only=True):
    """S and Q in force from now on."""

    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    sensitivity: list[list[float]]
    offset: list[float]
    standard_uncertainty: list[float]  # 12, S row by row, then Q
    covariance: list[list[float]]
    coverage_factor: float
    determined: list[bool]
    method: str
    uncertainty_kind: str  # "type A, white" until the adjustment is in force
    windows: int
    residual_sd: list[float]  # per output axis, output unit
    output_unit: str
    identity: str  # device kind, serial number and settings this calibration belongs to


class StatusChange(msgspec.Struct, frozen=True, kw_only=True):
    """CalibrationStatus of a sensor, with the reason."""

    run_id: str
    sequence: int
    sensor: str
    t_utc_ns: int
    status: Literal["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
    before: str
    reason: str


Result = WindowReport | CalibrationUpdate | StatusChange
