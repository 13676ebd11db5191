"""The samples of a session: readers fill it while a person turns the sensor; stretches are cut from it at any time."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.acquisition.reader import EventQueue, reader_of
from agent.config import Config
from agent.core.events import DeviceChange, Event, Gap
from calib.model import Array
from hw.block import BlockFlags, SampleBlock

POLL_S = 0.1
STOP_S = 1.0
MOST_S = 4 * 3600.0  # of samples that are kept: 0.5 GB of two devices at 1 kHz
LONGEST_HOLE_S = 10.0  # a longer one is left to the time stamps


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSamples:
    """Samples of one device: stamps (n,) in s, which are the arrivals of the bursts, and indications (n, axes).

    A row of NaN for each missing sample that the device counted. `temperature_degc` (n,) is NaN where none is told.
    """

    time_s: Array
    values: Array
    temperature_degc: Array


class Capture(threading.Thread):
    """Reads the named devices until `close`. All methods may be called from any thread."""

    def __init__(self, config: Config, devices: list[str]) -> None:
        super().__init__(name="capture", daemon=True)
        self._events = EventQueue(len(devices))
        self._readers = [reader_of(device, self._events) for device in config.devices if device.name in devices]
        self._origin_ns = time.monotonic_ns()
        self._lock = threading.Lock()
        self._blocks: dict[str, list[SampleBlock]] = {name: [] for name in devices}
        self._infos: dict[str, dict[str, Any]] = {}
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stop_request = threading.Event()
        self._full = False

    def __enter__(self) -> Capture:
        for reader in self._readers:
            reader.start()
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        for reader in self._readers:
            reader.stop()
        self._stop_request.set()
        for thread in (*self._readers, self):
            thread.join(STOP_S)

    def run(self) -> None:
        """Take events until `__exit__`."""
        while not self._stop_request.is_set():
            for gap in self._events.take_gaps():
                self._take(gap)
            event = self._events.get(POLL_S)
            if event is not None:
                self._take(event)
            for reader in self._readers:
                reader.watch()

    def _take(self, event: Event) -> None:
        if isinstance(event, SampleBlock):
            if self.now_s > MOST_S:
                if not self._full:
                    self._said.put(f"samples after {MOST_S / 3600.0:g} hours are not kept: end this session")
                self._full = True
                return
            with self._lock:
                self._blocks[event.device].append(event)
        elif isinstance(event, DeviceChange):
            if event.state == "lost":
                self._said.put(f"{event.device} is lost: {event.message}")
            with self._lock:
                if event.info_json:
                    self._infos[event.device] = json.loads(event.info_json)
        elif isinstance(event, Gap):
            self._said.put(f"{event.device}: {event.dropped} {event.unit} dropped, {event.reason}")

    @property
    def now_s(self) -> float:
        """Seconds since the session began, as in the stamps."""
        return (time.monotonic_ns() - self._origin_ns) * 1e-9

    def info(self, device: str) -> dict[str, Any] | None:
        """What the driver read of a device; None before it was opened."""
        with self._lock:
            return self._infos.get(device)

    def messages(self) -> list[str]:
        """What happened to devices since the last call."""
        return [self._said.get() for _ in range(self._said.qsize())]

    def newest_s(self, device: str) -> float | None:
        """Arrival of the newest block; None before the first one."""
        with self._lock:
            blocks = self._blocks[device]
            return (blocks[-1].t_monotonic_ns - self._origin_ns) * 1e-9 if blocks else None

    def silent(self, devices: Iterable[str], now_s: float, after_s: float) -> str | None:
        """The first of the devices that has sent nothing for `after_s`; None if all do."""
        for device in devices:
            newest_s = self.newest_s(device)
            if newest_s is None or now_s - newest_s > after_s:
                return device
        return None

    def record(self, since_s: float = 0.0) -> dict[str, DeviceSamples]:
        """The samples of all devices in the blocks that arrived after `since_s`."""
        return {device: self._samples(device, since_s) for device in self._blocks}

    def _samples(self, device: str, since_s: float) -> DeviceSamples:
        with self._lock:
            blocks = [b for b in self._blocks[device] if b.t_monotonic_ns >= self._origin_ns + since_s * 1e9]
        stamps, values, warm = [np.zeros(0)], [], [np.zeros(0)]
        following: int | None = None
        for block in blocks:
            arrived = (block.burst_t_monotonic_ns - self._origin_ns) * 1e-9
            missing = 0 if following is None else block.first_index - following
            if not 0 < missing < LONGEST_HOLE_S * block.nominal_rate_hz or block.flags & BlockFlags.RESTART:
                missing = 0
            stamps += [np.full(missing, arrived[0]), np.repeat(arrived, np.diff(block.burst_count, prepend=0))]
            values += [np.full((missing, block.indications.shape[1]), np.nan), block.indications.astype(np.float64)]
            degc = np.nan if block.temperature_degc is None else block.temperature_degc
            warm.append(np.full(missing + block.n, degc))
            following = block.first_index + block.n
        return DeviceSamples(
            np.concatenate(stamps), np.concatenate(values or [np.zeros((0, 3))]), np.concatenate(warm)
        )  # fmt: skip
