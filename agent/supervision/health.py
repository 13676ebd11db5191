"""The gateway's status: the state of its devices, queues, disk and network, and whether any of them has a fault.

The status describes this process at this moment. It is not a result and is not recorded: a replay could not compute it
again (memory, queues, disk), and the recording has the events that it follows from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec

from agent.config import Config
from agent.core.events import (
    CalibrationUpdate,
    DeviceChange,
    DriftReport,
    Event,
    Gap,
    Result,
    SelfTestRun,
    StatusChange,
    WindowReport,
)
from agent.delivery.mqtt import MqttState
from agent.supervision.devices import DeviceHealth, DeviceWatch
from hw.block import SampleBlock
from hw.sensor import load_driver

# s without samples after which an open device is reported; ten blocks of most devices. By default a sensor's status
# becomes INVALID after the same time.
SILENT_S = 5.0
BEHIND = 0.5  # fraction of a queue's capacity from which it is reported; a machine that keeps up stays below 0.1

State = Literal["starting", "running", "degraded", "stopping"]


class Queue(msgspec.Struct, frozen=True, kw_only=True):
    """Events that wait between two threads."""

    waiting: int
    capacity: int


class RecordingHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The file being written. `space`: what the lack of free space means for older recordings; "" where none lacks."""

    active: bool
    file: str
    size_bytes: int
    fault: str
    space: str = ""


class PublicationHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The publication. `unpublished`: results that wait in the store; null where the store cannot be read.

    `reopened`: Zenoh sessions of this run that were closed because the router did not hear them.
    """

    enabled: bool
    connected: bool
    unpublished: int | None
    fault: str
    reopened: int = 0


class ProcessHealth(msgspec.Struct, frozen=True, kw_only=True):
    """Resources that this process uses."""

    rss_bytes: int
    threads: int
    open_files: int
    cpu_s: float


class Situation(msgspec.Struct, frozen=True, kw_only=True):
    """What is measured at one moment, apart from what follows from the events."""

    queues: dict[str, Queue]
    recording: RecordingHealth
    publication: PublicationHealth
    disk_free_bytes: int | None
    process: ProcessHealth | None
    mqtt: MqttState | None = None


class InForce(msgspec.Struct, frozen=True, kw_only=True):
    """The calibration in force. `made_utc_ns`: when it was made; a restart does not change it.

    `sensitivity` 3 x 3 and `offset` 3 in `output_unit` (per m/s2). `expanded_uncertainty`: 12, S row by row, then Q.
    """

    made_utc_ns: int
    sensitivity: list[list[float]]
    offset: list[float]
    expanded_uncertainty: list[float]
    coverage_factor: float
    output_unit: str


class SensorHealth(msgspec.Struct, frozen=True, kw_only=True):
    """Results of one sensor since the run began. `calibrations` were made in this run: one restored is none of them.
    `windows_refused` counts all windows that were not used, held ones among them.

    `drifts`: the newest verdict of the drift test on each parameter that it has judged, also in earlier runs.
    """

    status: str
    reason: str
    windows_used: int
    windows_refused: int
    calibrations: int
    in_force: InForce | None = None
    drifts: dict[str, str] = {}


class GatewayStatus(Situation, frozen=True, kw_only=True):
    """The content of `<gateway>/status`. `reasons`: why `state` is degraded.

    `advice`: what is not good about the options of a device; the device works with them all the same.
    """

    site: str
    gateway: str
    version: str
    run_id: str
    t_utc_ns: int
    uptime_s: float
    state: State
    reasons: list[str]
    advice: list[str]
    devices: dict[str, DeviceHealth]
    sensors: dict[str, SensorHealth]

    @property
    def line(self) -> str:
        """The status in one line of text."""
        if self.reasons:
            return f"{self.state}: {'; '.join(self.reasons)}"
        rates = ", ".join(f"{n} {d.rate_hz:.1f} Hz" for n, d in self.devices.items() if d.rate_hz is not None)
        calibrations = ", ".join(f"{name} {sensor.status}" for name, sensor in self.sensors.items() if sensor.status)
        return "; ".join(part for part in (self.state, rates, calibrations) if part)


class Health:
    """Collects the status from the events and results of a run. Not thread-safe: only the main loop may call it."""

    def __init__(self, config: Config, version: str, run_id: str, origin_ns: int) -> None:
        self._config = config
        self._version = version
        self._run_id = run_id
        self._origin_ns = origin_ns
        self._devices = {device.name: DeviceWatch() for device in config.devices}
        options = {d.name: load_driver(d.driver).options_model.model_validate(d.options) for d in config.devices}
        self._advice = [f"{name}: {advice}" for name, held in options.items() for advice in held.advice]
        nothing = SensorHealth(status="", reason="", windows_used=0, windows_refused=0, calibrations=0)
        self._sensors = {channel.sensor: nothing for channel in config.channels}

    @property
    def started(self) -> bool:
        """Whether every device was opened, or the attempt failed and gave a reason."""
        return all(device.tried for device in self._devices.values())

    def update(self, event: Event, results: Sequence[Result]) -> None:
        """Take an event that the pipeline has processed, with its results."""
        if isinstance(event, SampleBlock):
            self._devices[event.device].on_block(event)
        elif isinstance(event, DeviceChange):
            self._devices[event.device].on_change(event)
        elif isinstance(event, Gap):
            self._devices[event.device].on_gap(event)
        elif isinstance(event, SelfTestRun):
            self._devices[event.device].on_self_test(event)
        for result in results:
            self._take(result)

    def remember(self, reports: Sequence[DriftReport]) -> None:
        """Take verdicts of the drift test of earlier runs, oldest first."""
        for report in reports:
            if report.sensor in self._sensors:
                self._take(report)

    def state(self, now_ns: int, situation: Situation, faults: Sequence[str]) -> tuple[State, list[str]]:
        """The state at `now_ns` (CLOCK_MONOTONIC) and its reasons, which include `faults`. Takes microseconds."""
        reasons = [
            f"{name} {fault}" for name, device in self._devices.items() if (fault := device.fault(now_ns, SILENT_S))
        ]
        reasons += [*self._troubles(situation), *faults]
        return ("degraded" if reasons else "running") if self.started else "starting", reasons

    def status(self, now_ns: int, utc_ns: int, situation: Situation, state: State, reasons: list[str]) -> GatewayStatus:
        """The whole status at `now_ns` (CLOCK_MONOTONIC). Takes some milliseconds for each device."""
        return GatewayStatus(
            site=self._config.gateway.site,
            gateway=self._config.gateway.name,
            version=self._version,
            run_id=self._run_id,
            t_utc_ns=utc_ns,
            uptime_s=(now_ns - self._origin_ns) * 1e-9,
            state=state,
            reasons=reasons,
            advice=self._advice,
            devices={name: device.health(now_ns) for name, device in self._devices.items()},
            sensors=dict(self._sensors),
            **msgspec.structs.asdict(situation),
        )

    def _take(self, result: Result) -> None:
        sensor = self._sensors[result.sensor]
        if isinstance(result, WindowReport):
            used, refused = sensor.windows_used + result.used, sensor.windows_refused + (not result.used)
            sensor = msgspec.structs.replace(sensor, windows_used=used, windows_refused=refused)
        elif isinstance(result, CalibrationUpdate):
            made = sensor.calibrations + (not result.made_sequence)
            sensor = msgspec.structs.replace(sensor, calibrations=made, in_force=_in_force(result))
        elif isinstance(result, DriftReport):
            sensor = msgspec.structs.replace(sensor, drifts={**sensor.drifts, result.parameter: result.verdict})
        elif isinstance(result, StatusChange):
            sensor = msgspec.structs.replace(sensor, status=result.status, reason=result.reason)
        self._sensors[result.sensor] = sensor

    def _troubles(self, now: Situation) -> list[str]:
        """The faults of the situation. Their text has no changing numbers, so that a lasting fault keeps its text."""
        least, publication = int(self._config.supervision.least_disk_free), now.publication
        behind = [name for name, queue in now.queues.items() if queue.waiting > BEHIND * queue.capacity]
        told = {
            f"not recording: {now.recording.fault}": not now.recording.active and now.recording.fault,
            f"recordings: {now.recording.space}": now.recording.space,
            f"less than {least / 1e6:g} MB free on the disk of the data": (now.disk_free_bytes or least) < least,
            "the store cannot be read": publication.unpublished is None,
            "no Zenoh router, results wait in the store": publication.enabled and not publication.connected,
            f"publication: {publication.fault}": publication.fault,
            f"MQTT: {now.mqtt.fault if now.mqtt else ''}": now.mqtt is not None and now.mqtt.fault,
            f"queue more than half full, the agent is too slow: {', '.join(behind)}": behind,
        }
        return [words for words, holds in told.items() if holds]


def _in_force(update: CalibrationUpdate) -> InForce:
    return InForce(
        made_utc_ns=update.date_utc_ns,
        sensitivity=update.sensitivity,
        offset=update.offset,
        expanded_uncertainty=[update.coverage_factor * u for u in update.standard_uncertainty],
        coverage_factor=update.coverage_factor,
        output_unit=update.output_unit,
    )
