"""What goes into the pipeline (events) and what comes out of it (results). Both are recorded in this form.

All times are the gateway's: `t_monotonic_ns` is CLOCK_MONOTONIC of the boot named by `boot_id`, `t_utc_ns` is UTC.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

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


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """What an operator asked for; refused ones are events as well, for the record, and change nothing.

    `arguments_json` by verb: pose {"theta_deg", "alpha_deg"} or {"direction", "gravity_mps2"} or {"gravity_mps2"} with
    an optional "position"; hold {} or {"release": true}; accept {"sequence"} of an Estimate; rollback {"sequence"} of
    a calibration, which the event then carries whole in `calibration_json`. `key_id` is of the key that signed it, in a
    refused one what the sender said it was; `counter` is 0 there.
    """

    sensor: str
    verb: Literal["pose", "hold", "accept", "rollback"]
    t_monotonic_ns: int
    t_utc_ns: int
    arguments_json: str = "{}"
    calibration_json: str = ""
    key_id: str = ""
    counter: int = 0
    refused: str = ""  # why; "" where it was taken


class Pruned(msgspec.Struct, frozen=True, kw_only=True):
    """Recordings that were deleted to keep to their limits: all of these numbers, so that no one need suspect theft."""

    t_monotonic_ns: int
    t_utc_ns: int
    first_file: int
    last_file: int
    last_sha256: str  # of the last of them, hexadecimal: the file after it names the same
    bytes: int


Event = RunStart | SampleBlock | DeviceChange | Gap | Command | Pruned | Tick


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """What follows from events.

    A subclass here and the protobuf message that is called as its `what`, with a capital letter and fields of the same
    names, make a new kind: it is recorded, stored, published and shown by that name. `routine` results come by
    schedule: they are not written to the log.
    """

    what: ClassVar[str]
    routine: ClassVar[bool] = False

    run_id: str
    sequence: int  # of all results of the gateway
    sensor: str
    t_utc_ns: int


class WindowReport(Result, frozen=True, kw_only=True):
    """The verdict on one window."""

    what: ClassVar[str] = "window"

    start_s: float  # since the sensor's first sample
    stop_s: float
    position: str
    used: bool
    reason: str
    points: int
    left_out: int
    numbers: dict[str, float]  # the statistics behind the verdict, each with its unit in its name
    fault: str = ""  # where the program itself failed: exception, file and line; "" where it did not


class CalibrationUpdate(Result, frozen=True, kw_only=True):
    """S and Q in force from now on.

    Where a parameter is not determined its value and uncertainty are the prior's. At a temperature T the offset is
    Q + sum of offset_temperature[k - 1] (T - T0)^k over k = 1.., T0 = reference_temperature_degc, and row i of S is
    multiplied by 1 + sensitivity_temperature[i] (T - T0); both were seen between the two ends of the range only.
    """

    what: ClassVar[str] = "calibration"

    sensitivity: list[list[float]]
    offset: list[float]
    standard_uncertainty: list[float]  # 12, S row by row, then Q
    covariance: list[list[float]]
    coverage_factor: float
    determined: list[bool]
    method: str
    uncertainty_kind: str
    windows: int
    residual_sd: list[float]  # per output axis, output unit
    output_unit: str
    identity: str  # device kind, serial number and settings this calibration belongs to
    reference_temperature_degc: float = float("nan")  # NaN where the device tells no temperature
    temperature_low_degc: float = float("nan")
    temperature_high_degc: float = float("nan")
    offset_temperature: list[list[float]] = []  # (order, 3), output unit per K^k
    u_offset_temperature: list[list[float]] = []
    sensitivity_temperature: list[float] = []  # (3,) per K; empty where it is not modelled
    u_sensitivity_temperature: list[float] = []
    offset_rate: list[float] = []  # (3,) output unit per day
    u_offset_rate: list[float] = []
    # Where it comes into force again, after a restart or by a rollback: which result it was when it was made.
    made_run_id: str = ""
    made_sequence: int = 0
    made_utc_ns: int = 0

    @property
    def made(self) -> tuple[str, int]:
        """(run, sequence) of the result by which it first came into force: its identity, the same each time."""
        return (self.made_run_id, self.made_sequence) if self.made_sequence else (self.run_id, self.sequence)

    @property
    def date_utc_ns(self) -> int:
        """When it was made; `t_utc_ns` is since when it is in force."""
        return self.made_utc_ns or self.t_utc_ns


class Estimate(Result, frozen=True, kw_only=True):
    """S and Q as the data have them, not in force: they wait for an operator's `accept` of this `sequence`."""

    what: ClassVar[str] = "estimate"

    reason: str
    calibration: CalibrationUpdate


class DriftReport(Result, frozen=True, kw_only=True):
    """The sequential test's verdict on one parameter, whenever it changes. It is the sensor or the reference: data
    cannot tell."""

    what: ClassVar[str] = "drift"

    parameter: str  # of calib.model.PARAMETERS
    verdict: Literal["stable", "drifting", "stepped"]
    change: float  # stepped: by how much, output unit (per m/s2)
    u_change: float
    rate: float  # drifting: a day
    u_rate: float
    onset_utc_ns: int  # stepped: since when
    statistic: float
    threshold: float
    false_alarms_a_year: float
    reason: str


class StatusChange(Result, frozen=True, kw_only=True):
    """CalibrationStatus of a sensor, with the reason."""

    what: ClassVar[str] = "status"

    status: Literal["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
    before: str
    reason: str


class ClockReport(Result, frozen=True, kw_only=True):
    """How the clock of one device runs against the gateway's, once a minute of the run; NaN is unknown.

    A clock model gives each sample its time. `offset_s`, `jitter_s` and `arrivals` are of the bursts that the model
    rests on: those of the last minute, of a longer time where `window_s` is longer, 8192 at most.
    """

    what: ClassVar[str] = "clock"
    routine: ClassVar[bool] = True

    device: str
    role: Literal["sensor", "reference"]
    nominal_rate_hz: float  # as the driver states it
    rate_hz: float  # at the newest sample
    u_rate_hz: float
    offset_s: float  # median of: arrival of a burst, less the model's time of the newest sample in it
    u_offset_s: float
    jitter_s: float  # SD of the same, robust: 1.4826 times the median absolute deviation from the median
    lag_s: float  # role sensor: by which its indications come after the reference's; reference: NaN
    u_lag_s: float
    arrivals: int


@dataclass(frozen=True, slots=True, eq=False)
class Acceleration:
    """A block of the corrected stream, a = S^-1 (V - Q) in m/s2, in the sensor's frame.

    `acceleration` (N, 3); sample i was taken at `t_utc_ns` + i / `rate_hz`. `covariance` (3, 3) in m2/s4 is the
    calibration's part at the block's mean, `noise` (3,) in m/s2 the residual SD of one sample. `determined` (12,) of
    the calibration used, which `calibration_run_id` and `calibration_sequence` name (0: the prior). It has no number of
    its own: `first_index` counts.
    """

    sensor: str
    t_utc_ns: int
    first_index: int
    rate_hz: float
    acceleration: NDArray[np.float64]
    covariance: NDArray[np.float64]
    noise: NDArray[np.float64]
    determined: NDArray[np.bool_]
    calibration_run_id: str
    calibration_sequence: int
    dynamic_only: bool  # an AC-coupled sensor: its mean means nothing
    recorded: bool  # whether it goes into the recording as well


RESULTS: dict[str, type[Result]] = {kind.what: kind for kind in Result.__subclasses__()}
Output = Result | Acceleration
