"""The parts of a run that the supervision watches, and what it measures of them."""

from __future__ import annotations

import os
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from agent.core.events import DriftReport
from agent.delivery.history import StoreError
from agent.delivery.mqtt import MqttPublisher
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.recording.thread import CAPACITY, RecordingThread
from agent.recording.writer import Recorder
from agent.supervision.health import (
    ProcessHealth,
    PublicationHealth,
    Queue,
    RecordingHealth,
    Situation,
)

MOST_DRIFTS = 120  # ten changes of verdict of each of the twelve parameters
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class QueueFill(Protocol):
    """A bounded queue: the number of entries that wait in it, and the number at which it is full."""

    @property
    def waiting(self) -> int: ...
    @property
    def capacity(self) -> int: ...


class Outbox:
    """Counts the results that wait in the store. The store is read only when this number may have changed."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._asked: tuple[int, int] | None = None
        self._count: int | None = 0

    def count(self) -> int | None:
        """Number of stored results that are not published yet; None where the store cannot be read."""
        now = self._store.published(), self._store.last_sequence()
        if now != self._asked:
            self._asked, self._count = now, self._read(*now)
        return self._count

    @property
    def faults(self) -> list[str]:
        """What in the store was not what the gateway's key signed."""
        return self._store.faults

    def drifts(self, sensor: str) -> list[DriftReport]:
        """The newest stored verdicts of the drift test on a sensor, oldest first; none if the store is not readable."""
        try:
            with self._store.history() as history:
                found = [record.result for record in history.newest(sensor, "drift", limit=MOST_DRIFTS)]
        except (StoreError, sqlite3.Error):
            return []
        return [report for report in reversed(found) if isinstance(report, DriftReport)]

    def _read(self, published: int, last: int) -> int | None:
        if published >= last:
            return 0
        try:
            with self._store.history() as history:
                return history.count_after(published)
        except (StoreError, sqlite3.Error):
            return None


@dataclass(frozen=True, slots=True)
class Plant:
    """The parts of one run. The main loop may read them at any time; no method waits."""

    data_dir: Path
    events: QueueFill
    writer: RecordingThread
    recorder: Recorder
    outbox: Outbox
    publisher: Publisher | None
    mqtt: MqttPublisher | None

    def situation(self) -> Situation:
        """Measure the present situation. Takes half a millisecond."""
        path = self.recorder.path
        return Situation(
            queues={
                "pipeline": Queue(waiting=self.events.waiting, capacity=self.events.capacity),
                "recording": Queue(waiting=self.writer.waiting, capacity=CAPACITY),
            },
            recording=RecordingHealth(
                active=path is not None,
                file=path.name if path else "",
                size_bytes=self.recorder.size_bytes,
                fault=self.recorder.fault,
                space=self.recorder.space,
            ),
            publication=self._publication(),
            disk_free_bytes=_disk_free_bytes(self.data_dir),
            process=_process(),
            mqtt=self.mqtt.state() if self.mqtt is not None else None,
        )

    def _publication(self) -> PublicationHealth:
        if self.publisher is None:
            return PublicationHealth(enabled=False, connected=False, unpublished=0, fault="")
        state = self.publisher.state()
        return PublicationHealth(
            enabled=True, connected=state.connected, unpublished=self.outbox.count(), fault=state.fault,
            reopened=state.reopened,
        )  # fmt: skip


def _disk_free_bytes(directory: Path) -> int | None:
    try:
        there = os.statvfs(directory)
    except OSError:
        return None
    return there.f_bavail * there.f_frsize


def _process() -> ProcessHealth | None:
    try:
        resident_pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
        return ProcessHealth(
            rss_bytes=resident_pages * _PAGE_BYTES,
            threads=len(os.listdir("/proc/self/task")),
            open_files=len(os.listdir("/proc/self/fd")) - 1,  # without the one that the listing itself opens
            cpu_s=time.process_time(),
        )
    except OSError:  # no further file can be opened: the agent continues with the open ones
        return None
