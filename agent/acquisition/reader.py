"""Reader threads, one for each device, which fill one bounded queue.

Devices may be unplugged and plugged in again. All dropped data are reported.
"""

from __future__ import annotations

import json
import queue
import threading
import time
from dataclasses import asdict, replace
from typing import Any

from agent.core.events import DeviceChange, Event, Gap
from hw.block import BlockFlags, SampleBlock
from hw.sensor import ConfigurationError, DeviceError, Sensor

BLOCKS_A_SECOND = 2
QUEUE_S = 30  # s of blocks of every device that the queue can hold
BACK_OFF_S = (0.1, 5.0)  # first and longest pause between two attempts to open a device again
CONFIGURATION_BACK_OFF_S = 5.0  # after a configuration error, which only a person can correct


class EventQueue:
    """The queue from the readers to the main loop.

    Only blocks are limited in number. When the queue is full a new block is dropped and counted; `take_gaps` gives the
    counts as `Gap` events. Other events, at most a few per second, are always accepted.
    """

    def __init__(self, devices: int) -> None:
        self._queue: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._size = QUEUE_S * BLOCKS_A_SECOND * devices
        self._dropped: dict[str, int] = {}
        self._flags: dict[str, BlockFlags] = {}  # of dropped blocks; the next block takes them over
        self._lock = threading.Lock()

    def put(self, device: str, event: Event) -> None:
        """Add an event, or count a block as dropped. Only the device's own thread may call it. Never blocks."""
        if isinstance(event, SampleBlock):
            flags = self._flags.pop(device, BlockFlags.NONE) | event.flags
            if self._queue.qsize() >= self._size:
                self._flags[device] = flags & ~BlockFlags.SATURATED
                with self._lock:
                    self._dropped[device] = self._dropped.get(device, 0) + 1
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
            return self._queue.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None

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


class Reader(threading.Thread):
    """Opens a device and reads it until `stop`. Where the device is lost it opens it again, with growing pauses."""

    def __init__(self, name: str, sensor: Sensor, events: EventQueue) -> None:
        super().__init__(name=f"reader-{name}", daemon=True)
        self.device = name
        self._sensor = sensor
        self._events = events
        self._stop_request = threading.Event()
        self._said = ""
        self._attempt = 0  # attempts to open the device since the last block

    def stop(self) -> None:
        """Ask the thread to end. It ends within the time of one block."""
        self._stop_request.set()

    def run(self) -> None:
        """Read until `stop`. An exception in a driver is reported and does not end the thread."""
        while not self._stop_request.is_set():
            least_pause_s = 0.0
            try:
                info = self._sensor.open()
                self._report("open", f"{info.kind} {info.serial_number}".strip(), json.dumps(asdict(info)))
                self._said = ""
                self._read()
            except ConfigurationError as error:
                least_pause_s = CONFIGURATION_BACK_OFF_S
                self._report_lost(str(error))
            except DeviceError as error:
                self._report_lost(str(error))
            except (Exception, SystemExit) as error:  # a driver's own bug must not end the agent, nor this thread
                self._report_lost(f"fault in the driver: {type(error).__name__}: {error}")
            finally:
                self._sensor.close()
            back_off_s = min(BACK_OFF_S[1], BACK_OFF_S[0] * 2 ** min(self._attempt, 10))
            self._attempt += 1
            self._stop_request.wait(max(back_off_s, least_pause_s))

    def _read(self) -> None:
        while not self._stop_request.is_set():
            block = self._sensor.read_block()
            for drop in self._sensor.take_drops():
                self._events.put(
                    self.device,
                    Gap(
                        device=self.device,
                        t_monotonic_ns=time.monotonic_ns(),
                        dropped=drop.count,
                        unit=drop.unit,
                        reason=drop.reason,
                    ),
                )
            if block is not None:
                self._attempt = 0
                self._events.put(self.device, block)

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
