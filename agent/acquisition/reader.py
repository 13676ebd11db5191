"""Reader threads, one for each device, which fill one bounded queue.

Devices may be unplugged and plugged in again, and their drivers may have bugs. All dropped data are reported.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, TypeVar

from agent.acquisition.self_testing import SelfTesting, shown_by
from agent.config.channel import SelfTestPlan
from agent.config.devices import Device
from agent.core.events import IN_DRIVER, DeviceChange, Event, Gap, SelfTestRun
from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.promises import BlockCheck, as_driver_fault, checked_drops, checked_info, driver_of, words
from hw.self_test import SelfTestingSensor
from hw.sensor import AdapterError, ConfigurationError, DeviceError, DeviceLost, Sensor, load_driver, system_clock

BLOCKS_A_SECOND = 2
QUEUE_S = 30  # s of blocks of every device that the queue can hold
BACK_OFF_S = (0.1, 5.0)  # first and longest pause between two attempts to open a device again
CONFIGURATION_BACK_OFF_S = 5.0  # after a configuration error, which only a person can correct
HANGS_S = 30.0  # s in a driver after which it is reported; blocks take 0.5 s, openings some seconds
FAULTS_TOLD = 10  # faults of a driver in a row after which the report says what a person can do
SHORTEST_CALL_S = 0.002  # s from one call of read_block to the next

T = TypeVar("T")

_log = logging.getLogger(__name__)


class EventQueue:
    """The queue from the readers to the main loop.

    Only blocks are limited in number, those of each device by themselves. Beyond that a new block is dropped and
    counted; `take_gaps` gives the counts as `Gap` events. Other events, at most a few per second, are always accepted.
    """

    def __init__(self, devices: int) -> None:
        self._queue: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._size = QUEUE_S * BLOCKS_A_SECOND * devices
        self._blocks: Counter[str] = Counter()  # that wait, by device
        self._dropped: dict[str, int] = {}
        self._flags: dict[str, BlockFlags] = {}  # of dropped blocks; the next block takes them over
        self._lock = threading.Lock()

    def put(self, device: str, event: Event) -> None:
        """Add an event, or count a block as dropped. Only the device's own thread may call it. Never blocks."""
        if isinstance(event, SampleBlock):
            flags = self._flags.pop(device, BlockFlags.NONE) | event.flags
            with self._lock:
                full = self._blocks[device] >= QUEUE_S * BLOCKS_A_SECOND
                if full:
                    self._dropped[device] = self._dropped.get(device, 0) + 1
                else:
                    self._blocks[device] += 1
            if full:
                self._flags[device] = flags & ~BlockFlags.SATURATED
                return
            event = replace(event, flags=flags)
        self._queue.put(event)

    @property
    def waiting(self) -> int:
        """Events that wait for the pipeline."""
        return self._queue.qsize()

    @property
    def capacity(self) -> int:
        """Number of waiting events from which new blocks are dropped."""
        return self._size

    def get(self, timeout_s: float) -> Event | None:
        """The next event, or None after `timeout_s`."""
        try:
            event = self._queue.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None
        if isinstance(event, SampleBlock):
            with self._lock:
                self._blocks[event.device] -= 1
        return event

    def take_gaps(self) -> list[Gap]:
        """The blocks dropped since the last call, as one Gap for each device; fast where there is none."""
        if not self._dropped:
            return []
        with self._lock:
            dropped, self._dropped = self._dropped, {}
        now = time.monotonic_ns()
        return [
            Gap(device=d, t_monotonic_ns=now, dropped=n, unit="blocks", reason="the queue to the pipeline was full")
            for d, n in sorted(dropped.items())
        ]


class DeviceReader(threading.Thread):
    """Opens a device and reads it until `stop`. Where the device is lost it opens it again, with growing pauses.

    The driver may be a third party's, and may have a bug. What it returns is checked, what it raises is caught, and
    each call is timed, so that `watch` can tell of a driver that does not return.
    """

    def __init__(self, name: str, sensor: Sensor, events: EventQueue, self_testing: SelfTesting | None = None) -> None:
        super().__init__(name=f"reader-{name}", daemon=True)
        self.device = name
        self.refused = ""  # what the adapter of the bus refuses, as long as no block has come
        self._sensor = sensor
        self._self_testing = self_testing
        self._driver = driver_of(sensor)
        self._events = events
        self._stop_request = threading.Event()
        self._said = ""
        self._attempt = 0  # attempts to open the device since the last block
        self._faults = 0  # of the driver itself, since the last block
        self._works = False  # whether a block has come in this run
        self._call: tuple[str, float] | None = None  # the driver's method that runs now, and since when
        self._hanging: tuple[str, float] | None = None  # the call that `watch` has told of

    def stop(self) -> None:
        """Ask the thread to end. It ends within the time of one block, unless the driver does not return."""
        self._stop_request.set()

    def watch(self) -> None:
        """Report the device as lost where its driver does not return. The main loop calls this, at any time."""
        call = self._call
        if call is not None and call is not self._hanging and time.monotonic() - call[1] > HANGS_S:
            self._hanging = call
            self._report_lost(
                f"{IN_DRIVER} {self._driver}: it has not returned from {call[0]} for {HANGS_S:g} s. Restart the agent; "
                f"if it happens again, tell the author of the driver"
            )

    def run(self) -> None:
        """Read until `stop`. No exception in a driver ends the thread."""
        while not self._stop_request.is_set():
            least_pause_s = 0.0
            try:
                self._read()
            except ConfigurationError as error:
                least_pause_s = CONFIGURATION_BACK_OFF_S
                if isinstance(error, AdapterError) and not self._works:
                    self.refused = words(error)
                self._report_lost(words(error))
            except DeviceError as error:
                self._report_lost(words(error))
            except BaseException as error:  # also SystemExit, and what else ends a thread
                self._report_fault(error)
            self._close()
            back_off_s = min(BACK_OFF_S[1], BACK_OFF_S[0] * 2 ** min(self._attempt, 10))
            self._attempt += 1
            self._stop_request.wait(max(back_off_s, least_pause_s))

    def _read(self) -> None:
        """Open the device and hand on its blocks until `stop`. Raises what the driver raises, and BadDriverError."""
        opened = system_clock()
        info = checked_info(self._within(self._sensor.open))
        told = not self._faults  # after a fault of the driver, it is told when a block shows that the driver works
        if told:
            self._report_open(info)
        check = BlockCheck(self.device, info, opened)
        while not self._stop_request.is_set():
            began_s = time.monotonic()
            block = self._next_block(check)
            if block is not None:
                if not told:
                    self._report_open(info)
                told, self._works, self.refused = True, True, ""
                self._attempt = self._faults = 0
                self._events.put(self.device, block)
                if self._self_test(block, info):
                    return  # the device has to be opened again
            if not info.own_clock and (early_s := began_s + SHORTEST_CALL_S - time.monotonic()) > 0:
                self._stop_request.wait(early_s)  # a driver that does not wait must not take the processor

    def _close(self) -> None:
        try:
            self._within(self._sensor.close)
        except DeviceError as error:
            self._report_lost(words(error))
        except BaseException as error:
            self._report_fault(error)

    def _next_block(self, check: BlockCheck) -> SampleBlock | None:
        """The next block, None if none came; what was dropped before it is put into the queue."""
        block = self._within(self._sensor.read_block)
        try:
            for drop in checked_drops(self._within(self._sensor.take_drops)):
                self._report_drop(drop.count, drop.unit, words(drop.reason))
            return None if block is None else check.taken(block)
        except BaseException as error:
            if block is not None:
                self._report_drop(1, "blocks", f"{IN_DRIVER}: {as_driver_fault(error)}")
            raise

    def _within(self, method: Callable[..., T], **arguments: Any) -> T:
        """Call a method of the driver. Raises DeviceLost where it returned after `watch` told that it does not."""
        self._call = call = (method.__name__, time.monotonic())
        try:
            result = method(**arguments)
        finally:
            self._call = None
        if self._hanging is call:
            raise DeviceLost(f"the driver {self._driver} returned from {call[0]}, but after more than {HANGS_S:g} s")
        return result

    def _self_test(self, block: SampleBlock, info: DeviceInfo) -> bool:
        """Let the device test itself, if that is due; whether it did. Raises what the driver raises."""
        plan, sensor = self._self_testing, self._sensor
        if plan is None or info.nominal_sensitivity is None or not isinstance(sensor, SelfTestingSensor):
            return False
        answer = plan.update(block, info.nominal_sensitivity)
        motion = plan.motion_mps2.tolist()
        if answer == "skip":
            self._report_self_test("skipped", motion_mps2=motion, message=plan.too_much)
        if answer != "test":
            return False
        self._report_self_test("begun", motion_mps2=motion)
        try:
            shown = shown_by(sensor, self._within, self._stop_request.is_set)
        except BaseException as error:
            self._report_self_test("failed", motion_mps2=motion, message=as_driver_fault(error))
            raise
        if shown:
            self._report_self_test("done", motion_mps2=motion, **shown)
        return True

    def _report_self_test(self, state: Any, **shown: Any) -> None:
        now_ns, utc_ns = time.monotonic_ns(), time.time_ns()
        run = SelfTestRun(device=self.device, state=state, t_monotonic_ns=now_ns, t_utc_ns=utc_ns, **shown)
        self._events.put(self.device, run)

    def _report_drop(self, dropped: int, unit: Any, reason: str) -> None:
        now_ns = time.monotonic_ns()
        gap = Gap(device=self.device, t_monotonic_ns=now_ns, dropped=dropped, unit=unit, reason=reason)
        self._events.put(self.device, gap)

    def _report_open(self, info: DeviceInfo) -> None:
        self._report("open", f"{info.kind} {info.serial_number}".strip(), json.dumps(asdict(info)))
        self._said = ""

    def _report_fault(self, error: BaseException) -> None:
        """Report a fault of the driver itself; from the FAULTS_TOLD-th in a row on nothing more is reported."""
        self._faults += 1
        told = f"{IN_DRIVER} {self._driver}: {as_driver_fault(error)}"
        if self._faults == FAULTS_TOLD:
            told = (
                f"{IN_DRIVER} {self._driver}, {FAULTS_TOLD} times in a row. Use another version of the driver, and "
                f"tell its author; the agent tries again every {BACK_OFF_S[1]:g} s. The last fault: "
                f"{as_driver_fault(error)}"
            )
        if self._faults <= FAULTS_TOLD:
            self._report_lost(told)

    def _report_lost(self, message: str) -> None:
        # Only a new message is reported: the same one every few seconds for a month would fill the recording.
        if message != self._said:
            self._report("lost", message, "")
            self._said = message

    def _report(self, state: Any, message: str, info_json: str) -> None:
        self._events.put(
            self.device,
            DeviceChange(
                device=self.device,
                state=state,
                t_monotonic_ns=time.monotonic_ns(),
                t_utc_ns=time.time_ns(),
                message=message,
                info_json=info_json,
                attempt=self._attempt,
            ),
        )


def reader_of(device: Device, events: EventQueue, plan: SelfTestPlan | None = None) -> DeviceReader:
    """The reader of a device of a configuration that has passed its check. `plan` of its self-tests.

    Raises ConfigurationError if its driver cannot be made with these options.
    """
    factory = load_driver(device.driver)
    try:
        options = factory.options_model.model_validate(device.options)
        for advice in options.advice:
            _log.warning("%s: %s", device.name, advice)
        sensor = factory(device.name, options)
    except (Exception, SystemExit) as error:
        told = f"{device.name}: {IN_DRIVER} {device.driver!r}: it cannot be made: {as_driver_fault(error)}"
        raise ConfigurationError(told) from error
    return DeviceReader(device.name, sensor, events, SelfTesting(plan) if plan is not None else None)
