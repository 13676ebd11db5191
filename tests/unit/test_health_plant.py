"""What is measured of a run: the true figures, and none where the machine gives none."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import resource
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from agent.acquisition.reader import EventQueue
from agent.delivery.store import Store
from agent.supervision.health import Situation
from agent.supervision.plant import Outbox, Plant
from tests.unit.zenoh_site import record

TAKEN_BYTES = 64 << 20


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(tmp_path, 0)
    yield store
    store.close()


def plant(data_dir: Path, store: Store, **parts: Any) -> Plant:
    recorder = SimpleNamespace(path=data_dir / "fieldcal-000001.mcap.active", size_bytes=7, fault="", space="")
    publisher = SimpleNamespace(state=lambda: SimpleNamespace(connected=True, fault="", reopened=0))
    found: dict[str, Any] = {
        "events": EventQueue(2), "writer": SimpleNamespace(waiting=3), "recorder": recorder, "publisher": publisher,
        "outbox": Outbox(store), "mqtt": None,
    } | parts  # fmt: skip
    return Plant(data_dir, **found)


def situations(directory: Path) -> tuple[Situation, Situation]:
    """Before and after this process has taken 64 MiB, seven files and a thread."""
    store = Store(directory, 0)
    looked_at = plant(directory, store)
    before = looked_at.situation()
    # Mapped by itself: an ordinary array could come from what the allocator has kept.
    with mmap.mmap(-1, TAKEN_BYTES) as held:
        held.write(b"\1" * TAKEN_BYTES)
        opened = [open(os.devnull) for _ in range(7)]  # noqa: SIM115 - counted, then closed
        done = threading.Event()
        thread = threading.Thread(target=done.wait)
        thread.start()
        after = looked_at.situation()
        done.set()
        thread.join()
        for file in opened:
            file.close()
    store.close()
    return before, after


def without_a_file(directory: Path) -> Situation:
    """Where not one file can be opened."""
    store = Store(directory, 0)
    store.commit([record(1)])
    looked_at = plant(directory, store)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
    situation = looked_at.situation()
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    store.close()
    return situation


@pytest.fixture(scope="module")
def alone() -> Iterator[ProcessPoolExecutor]:
    """A process of its own: in this one, connections and threads of earlier tests end when they like, and without a
    file to be had they fail."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        yield process


@pytest.mark.slow
def test_memory_threads_files_and_disk_are_the_processs_own(alone: ProcessPoolExecutor, tmp_path: Path) -> None:
    before, after = alone.submit(situations, tmp_path).result()
    assert before.process is not None
    assert after.process is not None
    assert after.process.open_files - before.process.open_files == 7
    assert after.process.threads - before.process.threads == 1
    # What the allocator gave back meanwhile is not known to the byte.
    assert after.process.rss_bytes - before.process.rss_bytes > 0.8 * TAKEN_BYTES
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    assert after.disk_free_bytes == pytest.approx(free, rel=0.05)  # others write here too
    assert (after.queues["pipeline"].capacity, after.queues["recording"].waiting) == (120, 3)


def test_the_outbox_is_counted_as_it_fills_and_empties(tmp_path: Path, store: Store) -> None:
    outbox = plant(tmp_path, store).outbox
    assert outbox.count() == 0
    store.commit([record(n) for n in (5, 6, 9)])
    assert outbox.count() == 3
    store.mark_published(6)
    assert outbox.count() == 1
    store.mark_published(9)
    assert outbox.count() == 0


def test_an_outbox_that_cannot_be_read_is_not_known(tmp_path: Path, store: Store) -> None:
    store.commit([record(1)])
    store.path.rename(tmp_path / "away")
    assert plant(tmp_path, store).situation().publication.unpublished is None


@pytest.mark.slow
def test_without_a_file_to_be_had_it_goes_on(alone: ProcessPoolExecutor, tmp_path: Path) -> None:
    situation = alone.submit(without_a_file, tmp_path).result()
    assert situation.process is None
    assert situation.publication.unpublished is None


@pytest.mark.thorough
def test_a_run_without_network_or_recording_is_told_so(tmp_path: Path, store: Store) -> None:
    recorder = SimpleNamespace(path=None, size_bytes=0, fault="No space left on device", space="")
    situation = plant(tmp_path, store, recorder=recorder, publisher=None).situation()
    assert (situation.recording.active, situation.recording.fault) == (False, "No space left on device")
    assert not situation.publication.enabled
