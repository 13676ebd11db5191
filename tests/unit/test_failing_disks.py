"""Disks that are full, fail to sync, or are slow: the results go on, and are recorded again after."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from agent.audit.engines import Engines
from agent.cli.audit import audit_files
from agent.cli.given import GivenFiles
from agent.core.events import Event
from agent.recording.files import recordings
from agent.recording.thread import RecordingThread
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, SECOND, StandIn, block, run_start

REPOSITORY = Path(__file__).parents[2]
needs_root = pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="mounts a file system")

ON_A_SMALL_DISK = """
import json, sys
from pathlib import Path
import numpy as np
from agent.audit.engines import Engines
from agent.cli.audit import audit_files
from agent.cli.given import GivenFiles
from agent.delivery.history import History, StoredResult, StoreError
from agent.delivery.store import Store
from agent.recording.files import recordings
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, SECOND, StandIn, block, run_start
data = Path(sys.argv[1])
ballast = data / "ballast"
ballast.write_bytes(bytes(12 << 20))
store = Store(data, 0)
recorder = Recorder(data, ["acc"], ["bridge-1"], ledger=store)
pipeline, rng = StandIn(CONFIG), np.random.default_rng(1)
said, refused, number, block_number = [], 0, 0, 0

def feed(event):
    global number, refused
    results = pipeline.step(event)
    recorded = recorder.record(number, event, results)
    number += 1
    if results:
        records = [StoredResult.of(r, recorded=recorded, recording="") for r in results]
        said.extend((r.sequence, r.recorded) for r in records)
        try:
            store.commit(records)
        except StoreError:
            refused += 1

def go_on(blocks):
    global block_number
    for _ in range(blocks):
        feed(block("acc", block_number, rng, n=5000))
        block_number += 1
        recorder.sync()
        if recorder.wants_rotation:
            feed(run_start(pipeline, number, recorder.next_file_sequence, 5 * SECOND + block_number * SECOND // 2))

feed(run_start(pipeline, 0, 1))
phases = {}
def phase(name, blocks):
    go_on(blocks)
    phases[name] = {"recording": recorder.recording, "fault": recorder.fault, "refused": refused}

phase("before", 40)
for _ in range(100):
    if not recorder.recording:
        break
    go_on(20)
phase("no room for a recording", 100)
filler = open(data / "filler", "wb", buffering=0)
try:
    while filler.write(bytes(1 << 16)):
        pass
except OSError:
    pass
phase("no room for anything", 100)
ballast.unlink()
for _ in range(70):
    if recorder.recording:
        break
    go_on(10)
phase("room again", 20)
recorder.close()
store.close()
with History(store.path) as history:
    history.check()
    kept = [(r.sequence, r.recorded) for r in history.after(0, limit=100_000)]
audited = audit_files(GivenFiles([p for _, p in recordings(data)]), Engines(StandIn.restore))
print(json.dumps({"phases": phases, "said": said, "kept": kept, "files": len(audited),
                  "reasons": [reason for file in audited for reason in file.reasons]}))
"""


@pytest.mark.slow
@pytest.mark.root
@needs_root
def test_a_disk_that_is_full(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    mounted = f'mount -t tmpfs -o size=32m none "{data}" && exec "$0" -c "$1" "{data}"'
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", mounted, sys.executable, ON_A_SMALL_DISK],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    phases = told["phases"]
    assert [phase["recording"] for phase in phases.values()] == [True, False, False, True]
    assert "No space left on device" in phases["no room for a recording"]["fault"]
    refused = [phase["refused"] for phase in phases.values()]
    assert refused[1] == 0, "the store has room still"
    assert refused[2] > 10
    assert told["kept"] == told["said"], "no result is lost, and each says whether it is recorded"
    assert {recorded for _, recorded in told["said"]} == {True, False}
    assert [sequence for sequence, _ in told["said"]] == list(range(1, len(told["said"]) + 1))
    assert told["reasons"] == []
    assert told["files"] >= 2


def feed(thread: RecordingThread, count: int) -> float:
    """Put a run of blocks, each with results in it, as fast as it takes them; the longest that one waited, in s."""
    pipeline, rng = StandIn('{"window_blocks": 1}'), np.random.default_rng(1)
    longest_s = 0.0
    for number in range(count):
        event = run_start(pipeline, 0, 1) if number == 0 else block("acc", number, rng)
        results = pipeline.step(event)
        began_s = time.monotonic()
        thread.put(number, event, results)
        longest_s = max(longest_s, time.monotonic() - began_s)
    return longest_s


def test_a_slow_disk_holds_nobody_up_for_the_length_of_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk does not finish a sync before the whole queue was handed over: nothing is delivered until then."""
    ready = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: ready.wait(60.0))
    delivered: list[int] = []
    recorder = Recorder(tmp_path, ["acc"], ["bridge-1"])
    thread = RecordingThread(recorder, lambda number, *_: delivered.append(number))
    assert feed(thread, 150) < 30.0
    assert delivered == []
    ready.set()
    assert thread.close()
    assert delivered == list(range(150))


def test_a_sync_that_fails_gives_the_file_up_and_the_next_is_sound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[int, bool]] = []

    recorder = Recorder(tmp_path, ["acc"], ["bridge-1"])
    pipeline, rng, number = StandIn(CONFIG), np.random.default_rng(1), 0
    fsync = os.fsync
    failing = range(10, 14)

    def failing_fsync(descriptor: int) -> None:
        if number in failing:
            raise OSError(errno.EIO, "Input/output error")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing_fsync)
    for number in range(60):
        if number == 0 or recorder.wants_rotation:
            event: Event = run_start(pipeline, number, recorder.next_file_sequence, 5 * SECOND + number * SECOND)
        else:
            event = block("acc", 2 * number, rng)
        results = pipeline.step(event)
        recorded = recorder.record(number, event, results)
        told.extend((number, recorded) for _ in results)
    recorder.close()
    lost = [n for n, recorded in told if not recorded]
    assert lost
    assert min(lost) in failing
    assert max(lost) < min(failing) + 15, "ten seconds later the disk is tried again"
    assert [n for n, recorded in told if recorded and n > max(lost)]
    files = audit_files(GivenFiles([path for _, path in recordings(tmp_path)]), Engines(StandIn.restore))
    assert [file.reasons for file in files] == [[], []]
    assert [file.repaired for file in files] == [True, False]
