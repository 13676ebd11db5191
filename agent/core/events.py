"""Events are the input of the pipeline, results are its output. Both are recorded in this form.

All times are of the gateway's clocks: `t_monotonic_ns` is CLOCK_MONOTONIC of the boot named by `boot_id`, `t_utc_ns` is
UTC.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw.block import SampleBlock


class RunStart(msgspec.Struct, frozen=True, kw_only=True):
    """First event of every file, with everything that a replay needs.

    `continuation`: an earlier file has the same run. `engine`: the name (agent.engine.identity) of the engine that made
    the results of this file, and `engine_sha256` the digest of the wheel in which it is kept; "" where not known.
    """

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
    event_sequence: int  # number of this event; the next event has the next number
    continuation: bool = False
    engine: str = ""
    engine_sha256: str = ""


IN_DRIVER = "fault in the driver"  # so begins the message of a DeviceChange where the driver itself has failed


class DeviceChange(msgspec.Struct, frozen=True, kw_only=True):
    """A device was opened, lost, or opened again. `info_json` is what its driver read of it (JSON of DeviceInfo)."""

    device: str
    state: Literal["open", "lost"]
    t_monotonic_ns: int
    t_utc_ns: int
    message: str = ""
    info_json: str = ""
    attempt: int = 0


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """Data between device and pipeline were lost: by a full queue, unreadable lines, or a jump of the sample number."""

    device: str
    t_monotonic_ns: int
    dropped: int
    unit: Literal["samples", "blocks", "lines", "bytes"]
    reason: str


class Tick(msgspec.Struct, frozen=True, kw_only=True):
    """Time has passed. Ticks come also while no device sends data."""

    t_monotonic_ns: int
    t_utc_ns: int


class SelfTestRun(msgspec.Struct, frozen=True, kw_only=True):
    """A device tests itself: no samples come between `begun` and `done` or `failed`. `skipped`: it did not begin.

    All in m/s2, over the sensitivity of the data sheet. `motion_mps2` (3,): standard deviation of the samples before.
    `off_mps2` and `on_mps2`: means of the phases without and with the self-test, in turn, three after three; the first
    and the last phase is one without. `low_mps2`, `high_mps2` (3,): limits of the maker. The response grows with the
    supply to the power of `supply_exponent` (3,). `temperature_degc`: mean of all phases; NaN where none is told.
    """

    device: str
    state: Literal["begun", "done", "skipped", "failed"]
    t_monotonic_ns: int
    t_utc_ns: int
    message: str = ""  # why it was skipped, or has failed
    motion_mps2: list[float] = []
    off_mps2: list[float] = []
    on_mps2: list[float] = []
    low_mps2: list[float] = []
    high_mps2: list[float] = []
    supply_exponent: list[float] = []
    temperature_degc: float = float("nan")


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """A command of an operator. A refused command is an event too, so that it is recorded, but it changes nothing.

    `arguments_json` by verb: pose {"theta_deg", "alpha_deg"} or {"direction", "gravity_mps2"} or {"gravity_mps2"} with
    an optional "position"; hold {} or {"release": true}; accept {"sequence"} of an Estimate; rollback {"sequence"} of
    a calibration, which `calibration_json` then holds completely. `key_id` names the key that signed the command; in a
    refused command it is what the sender stated, and `counter` is 0.
    """

    sensor: str
    verb: Literal["pose", "hold", "accept", "rollback"]
    t_monotonic_ns: int
    t_utc_ns: int
    arguments_json: str = "{}"
    calibration_json: str = ""
    key_id: str = ""
    counter: int = 0
    refused: str = ""  # the reason; "" if the command was not refused


class Pruned(msgspec.Struct, frozen=True, kw_only=True):
    """The agent deleted its oldest recording, to stay within the configured limits.

    Events of older versions name all numbers from first to last, and neither `epoch` nor `previous_sha256`.
    """

    t_monotonic_ns: int
    t_utc_ns: int
    first_file: int
    last_file: int
    last_sha256: str  # of the last deleted file, hexadecimal; the next file holds the same value
    bytes: int
    epoch: str = ""  # of the store when the deleted file began
    previous_sha256: str = ""  # that the first deleted file names as the one of the file before it


Event = RunStart | SampleBlock | DeviceChange | Gap | SelfTestRun | Command | Pruned | Tick


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """A result of the pipeline.

    A new kind of result needs a subclass here and a protobuf message. The message has the name in `what` with a capital
    first letter, and fields of the same names. The result is then recorded, stored, published and shown under this
    name. `routine` results come by schedule and are not written to the log. `engine` names the code that made it
    (agent.engine.identity); "" in results of older versions.
    """

    what: ClassVar[str]
    routine: ClassVar[bool] = False

    run_id: str
    sequence: int  # counts all results of the gateway
    sensor: str
    t_utc_ns: int
    engine: str = ""


class WindowReport(Result, frozen=True, kw_only=True):
    """Whether one window was used, and why not."""

    what: ClassVar[str] = "window"

    start_s: float  # since the sensor's first sample
    stop_s: float
    position: str
    used: bool
    reason: str  # why it is refused or held (docs/reference/reasons.md); "" where it is used
    points: int
    left_out: int
    numbers: dict[str, float]  # the statistics on which the verdict rests, each with its unit in its name
    fault: str = ""  # if the program itself failed: exception, file and line; otherwise ""


class BandResponse(msgspec.Struct, frozen=True, kw_only=True):
    """The complex sensitivity in a band of frequency, the lag taken out, and its standard uncertainty; each 3 x 3."""

    low_hz: float
    high_hz: float
    sensitivity_re: list[list[float]]
    sensitivity_im: list[list[float]]
    standard_uncertainty: list[list[float]]


class SteadySensitivity(msgspec.Struct, frozen=True, kw_only=True):
    """The sensitivity at 0 Hz and its standard uncertainty; each 3 x 3, empty where the motion does not tell them."""

    sensitivity: list[list[float]] = []
    standard_uncertainty: list[list[float]] = []


class SharedError(msgspec.Struct, frozen=True, kw_only=True):
    """What S and Q owe to the errors of one reference, which all results of this reference share.

    `serial_number` and `certificate_sha256` (of the stated certificate) are "" where they are not known. `unknowns`
    are n errors of the reference; each entered with the mean `stated` and the standard uncertainty `u_stated` once, and
    `value` is its estimate. A row of `derivative` (n, 12) has the derivatives of S row by row and Q by one of `stated`,
    a row of `own_derivative` (n, n) those of `value`.
    """

    reference: str
    serial_number: str
    certificate_sha256: str
    sensitivity: list[float]  # by the certificate, indication per SI unit: one, or one for each channel
    unknowns: list[str]
    kinds: list[str]
    stated: list[float]
    u_stated: list[float]
    value: list[float]
    own_derivative: list[list[float]]
    derivative: list[list[float]]

    @property
    def has_its_shapes(self) -> bool:
        """Whether the lists have the lengths that `unknowns` says."""
        n, lists = len(self.unknowns), (self.kinds, self.stated, self.u_stated, self.value, self.derivative)
        rows = [len(row) for row in self.derivative] == [12] * n and [len(row) for row in self.own_derivative] == [
            n
        ] * n
        return rows and all(len(values) == n for values in lists)


class CalibrationUpdate(Result, frozen=True, kw_only=True):
    """S and Q that are in force from `t_utc_ns` on.

    S holds at `reference_frequency_hz`, and within a third of its expanded uncertainty in `valid_band_hz`. `response`
    is empty where the motion has no band that is wide enough to tell it.

    If a parameter is not determined, its value and uncertainty are those of the prior. At a temperature T the offset is
    Q + sum of offset_temperature[k - 1] (T - T0)^k over k = 1.., T0 = reference_temperature_degc, and the sensitivity
    S + sensitivity_per_k (T - T0). In results of engines before 13, row i of S is multiplied by
    1 + sensitivity_temperature[i] (T - T0) instead. Data exist only from temperature_low_degc to temperature_high_degc.
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
    reference_temperature_degc: float = float("nan")  # NaN if the device measures no temperature
    temperature_low_degc: float = float("nan")
    temperature_high_degc: float = float("nan")
    offset_temperature: list[list[float]] = []  # (order, 3), output unit per K^k
    u_offset_temperature: list[list[float]] = []
    sensitivity_temperature: list[float] = []  # (3,) per K; only of engines before 13
    u_sensitivity_temperature: list[float] = []
    sensitivity_per_k: list[list[float]] = []  # (3, 3); empty if the model has no such term, or no temperature is told
    u_sensitivity_per_k: list[list[float]] = []
    offset_rate: list[float] = []  # (3,) output unit per day
    u_offset_rate: list[float] = []
    # Identities of the references to whose errors S and Q owe their values; that of the newest window is the last.
    references: list[str] = []
    reference_frequency_hz: float = 0.0  # 0 if nothing moved yet
    valid_band_hz: list[float] = []  # [low, high]; empty where it is not known
    sensitivity_at_0hz: SteadySensitivity = msgspec.field(default_factory=SteadySensitivity)
    response: list[BandResponse] = []
    shared_errors: list[SharedError] = []  # by reference; empty where they are not known, as in older results
    # Standard uncertainties (12,) by source, whose squares add up to those of S and Q, and effective degrees of freedom
    # (12,). Of the first calibration in force of a UTC day, and of an adopted jump; else empty. Empty also where the
    # window of such a calibration made the whole be solved anew; `fieldcal show --budget` solves it once more.
    budget: dict[str, list[float]] = {}
    degrees_of_freedom: list[float] = []
    # If the calibration comes into force again, after a restart or by a rollback: the result that first put it in
    # force.
    made_run_id: str = ""
    made_sequence: int = 0
    made_utc_ns: int = 0
    made_engine: str = ""

    @property
    def made(self) -> tuple[str, int]:
        """(run, sequence) of the result that first put it in force.

        This identifies the calibration and never changes.
        """
        return (self.made_run_id, self.made_sequence) if self.made_sequence else (self.run_id, self.sequence)

    @property
    def by_engine(self) -> str:
        """Name of the engine that made it; "" in results of older versions."""
        return self.made_engine if self.made_sequence else self.engine

    @property
    def date_utc_ns(self) -> int:
        """Date of the calibration: when it was made. `t_utc_ns` is the time at which it came into force."""
        return self.made_utc_ns or self.t_utc_ns


class Estimate(Result, frozen=True, kw_only=True):
    """S and Q from the data that are not in force.

    An operator can put them in force by `accept` with this `sequence`.
    """

    what: ClassVar[str] = "estimate"

    reason: str
    calibration: CalibrationUpdate


class DriftReport(Result, frozen=True, kw_only=True):
    """The verdict of a drift test on one parameter, published when it changes.

    Two tests give verdicts: the drift test on windows (steps and fast drifts), and that of net changes (a week to four
    years; always "drifting", and its reason says "what is stated allows"). The first cannot show whether the sensor or
    the reference has changed; the second names one of them where a second reference or a statement tells.
    """

    what: ClassVar[str] = "drift"

    parameter: str  # of calib.model.PARAMETERS
    verdict: Literal["stable", "drifting", "stepped"]
    change: float  # size of the step, or how far the drift has come since its onset; output unit (per m/s2)
    u_change: float  # standard uncertainty of change; NaN of a net change, whose reason has what is stated for it
    rate: float  # for "drifting": change per day
    u_rate: float  # standard uncertainty of rate; NaN of a net change
    onset_utc_ns: int  # when the step or the drift began; of a net change: the first day of its span
    statistic: float  # of the test: above `threshold` when a change is told
    threshold: float
    false_alarms_a_year: float  # as stated for the sensor: of both tests and all parameters together
    reason: str


class StatusChange(Result, frozen=True, kw_only=True):
    """CalibrationStatus of a sensor, with the reason for it."""

    what: ClassVar[str] = "status"

    status: Literal["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
    before: str
    reason: str


class ClockReport(Result, frozen=True, kw_only=True):
    """How the clock of one device runs against the clock of the gateway, once in each minute of the run; NaN: unknown.

    A clock model gives each sample its time. `offset_s`, `jitter_s` and `arrivals` come from the bursts to which the
    model is fitted: those of the last minute, or of `window_s` if that is longer, and 8192 at most.
    """

    what: ClassVar[str] = "clock"
    routine: ClassVar[bool] = True

    device: str
    role: Literal["sensor", "reference"]
    nominal_rate_hz: float  # the rate that the driver states
    rate_hz: float  # at the newest sample
    u_rate_hz: float
    offset_s: float  # median of (arrival of a burst - time of the newest sample in it by the clock model)
    u_offset_s: float
    jitter_s: float  # robust SD of the same differences: 1.4826 times their median absolute deviation
    lag_s: float  # delay of the sensor's indications after the reference's; NaN for the reference
    u_lag_s: float
    arrivals: int


class WatchReport(Result, frozen=True, kw_only=True):
    """What one hour of a sensor without a reference shows, after that hour; NaN: not known.

    All is along the axes of the corrected acceleration, with the calibration in force at the end of the hour, which
    `calibration_run_id` and `calibration_sequence` name as `CalibrationUpdate.made` (0: the prior). The hour is that of
    UTC at the arrival of the samples. `samples` counts all of them, `duration_s` is the time that they cover; of these,
    `stuck` and `clipped` are in blocks with a wrong output or at the end of the range; `missing` are known to lack.
    `segments` of about a minute without such a block tell the rest. Their means give `mean_mps2`, and `mean_scatter`
    is the standard deviation of these means over the root of their number. `noise_psd` (3,) in (m/s2)2/Hz,
    `band_power` x, y, z and `cross_power` xy, xz, yz in (m/s2)2, one after the other, for each of the third octaves
    `band_hz` (calib.signal.spectra). `peak_frequency_hz` x, y, z: where the squared PSD lies in a window around each of
    them (calib.signal.spectra.peak_frequency), and its standard uncertainty; empty in results of earlier versions.
    `u_main_pct` (3,): standard uncertainty of the main sensitivities in force at the end of the hour. `gravity`: what
    the mean says beside that at the time of the calibration; "" while it says nothing.
    """

    what: ClassVar[str] = "watch"
    routine: ClassVar[bool] = True

    hour_utc_ns: int
    duration_s: float
    samples: int
    stuck: int
    clipped: int
    missing: int
    segments: int
    mean_mps2: list[float]
    mean_scatter_mps2: list[float]
    temperature_degc: float
    temperature_scatter_degc: float
    noise_psd: list[float]
    band_hz: list[float]
    band_power: list[float]
    cross_power: list[float]
    calibration_run_id: str
    calibration_sequence: int
    u_main_pct: list[float]
    gravity: str = ""
    peak_frequency_hz: list[float] = []
    u_peak_frequency_hz: list[float] = []


class SelfTestReport(Result, frozen=True, kw_only=True):
    """What the self-test of a device shows, or why it shows nothing (`reason`, else "").

    `response_mps2` (3,): change of the mean of x, y, z by the self-test, over the sensitivity of the data sheet, so
    that no calibration moves it; `u_response_mps2` from the scatter of `pairs` of phases with and without it; NaN where
    it did not run. `u_supply_pct` (3,): standard uncertainty of the response by the supply voltage, which nobody
    measures and which all axes share. `motion_mps2` (3,): standard deviation of the samples before. `faults`: what is
    beyond the limits of the maker.
    """

    what: ClassVar[str] = "self_test"

    reason: str
    response_mps2: list[float]
    u_response_mps2: list[float]
    u_supply_pct: list[float]
    pairs: int
    motion_mps2: list[float]
    temperature_degc: float
    faults: list[str]


@dataclass(frozen=True, slots=True, eq=False)
class Acceleration:
    """A block of the corrected stream, a = S^-1 (V - Q) in m/s2, in the sensor's frame.

    `acceleration` (N, 3); sample i was taken at `t_utc_ns` + i / `rate_hz`. `covariance` (3, 3) in m2/s4 is the
    calibration's part at the block's mean, `noise` (3,) in m/s2 the residual SD of one sample. `suspect` (3,): outputs
    of which samples in the block are wrong (calib.signal.outputs); S mixes them into each axis. `determined` (12,) of
    the calibration used, which `calibration_run_id` and `calibration_sequence` name (0: the prior). Blocks have no
    sequence number; `first_index` counts the samples.
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
    dynamic_only: bool  # True for an AC-coupled sensor: the mean acceleration is not measured
    suspect: NDArray[np.bool_]
    recorded: bool  # whether the block is written to the recording too


RESULTS: dict[str, type[Result]] = {kind.what: kind for kind in Result.__subclasses__()}
Output = Result | Acceleration
