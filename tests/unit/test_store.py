"""The store under what happens to files: killed writers, corruption, a second process, a full disk."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from agent.core.events import CalibrationUpdate, StatusChange
from agent.core.memory import MOST_MEMORIES, Memory
from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError, connect_read_only
from agent.delivery.store import WAITING_MAX, Store
from agent.recording.continuation import UNKEPT_MAX


def record(sequence: int, what: str = "window", sensor: str = "mems", **fields: object) -> StoredResult:
    given = {"run_id": "run-1", "payload": b'{"sequence":%d}' % sequence, "t_utc_ns": sequence, "recorded": True}
    given |= {"recording": "fieldcal-000001.mcap", "identity": ""} | fields
    return StoredResult(sequence=sequence, sensor=sensor, what=what, **given)  # type: ignore[arg-type]


def status(sequence: int, value: str, sensor: str = "mems") -> StoredResult:
    return record(sequence, "status", sensor, payload=b'{"status":"%s"}' % value.encode())


def sequences(records: list[StoredResult]) -> list[int]:
    return [r.sequence for r in records]


def test_what_is_committed_is_read_back_whole_and_in_order(tmp_path: Path) -> None:
    kept = [
        record(1),
        record(2, "calibration", identity="ADXL355 7"),
        record(3, sensor="other"),
        record(7, recorded=False),
    ]
    store = Store(tmp_path, 0)
    store.commit(kept[:3])
    store.commit(kept[3:])
    with History(store.path) as history:
        assert history.after(0, limit=10) == kept
        assert history.after(1, limit=2) == kept[1:3]
        assert sequences(history.after(0, [("mems", "window")], limit=10)) == [1, 7]
        assert history.after(0, [], limit=10) == []
        assert history.channels() == [("mems", "calibration"), ("mems", "window"), ("other", "window")]
        assert sequences(history.newest("mems", "window", limit=1)) == [7]
    store.close()


def test_one_commit_may_be_larger_than_what_waits_for_a_failing_disk(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(n) for n in range(1, WAITING_MAX + 100)])
    with History(store.path) as history:
        assert sequences(history.after(0, limit=2 * WAITING_MAX)) == list(range(1, WAITING_MAX + 100))
    store.close()


def test_a_calibration_is_in_force_until_the_status_is_uncalibrated_and_no_more_after(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit(
        [record(1, "calibration"), status(2, "VALID"), record(3, "calibration"), record(4, "calibration", "b")]
    )
    with History(store.path) as history:
        calibration = history.in_force("mems")
        assert calibration is not None
        assert calibration.sequence == 3
        store.commit([status(5, "UNCALIBRATED")])
        assert history.in_force("mems") is None
        assert sequences(history.latest()) == [4, 5]
        store.commit([status(6, "COLLECTING"), status(7, "INVALID")])
        assert sequences(history.latest()) == [4, 7]
        store.commit([record(8, "calibration"), status(9, "VALID"), status(10, "HELD")])
        assert sequences(history.latest()) == [4, 8, 10]
        assert history.in_force("none") is None
    store.close()


def test_only_the_calibration_of_the_same_device_may_be_restored(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(n, "calibration", identity=i) for n, i in ((1, "chip A"), (2, "chip A"), (3, "chip B"))])
    with History(store.path) as history:
        kept = history.calibrations("mems")
        assert {identity: r.sequence for identity, r in kept.items()} == {"chip A": 2, "chip B": 3}
        assert history.calibrations("other") == {}
    store.close()


def test_of_many_devices_in_one_place_the_states_of_the_newest_stay(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([], [Memory("other", "chip", 1, b"its")])
    for n in range(1, MOST_MEMORIES + 4):
        store.commit([], [Memory("mems", f"chip {n}", n, b"%d" % n)])
    store.commit([], [Memory("mems", "chip 4", MOST_MEMORIES + 4, b"again")])
    store.close()
    again = Store(tmp_path, 0)
    kept = {memory.identity: memory.state for memory in again.states if memory.sensor == "mems"}
    assert list(kept) == [f"chip {n}" for n in [*range(5, MOST_MEMORIES + 4), 4]]
    assert kept["chip 4"] == b"again"
    assert {memory.identity for memory in again.states if memory.sensor == "other"} == {"chip"}
    again.close()


def test_record_of_a_result_says_whether_it_is_recorded_and_has_null_for_nan() -> None:
    update = CalibrationUpdate(
        run_id="r", sequence=4, sensor="mems", t_utc_ns=5, sensitivity=[[float("nan")] * 3] * 3, offset=[0.0] * 3,
        standard_uncertainty=[0.0] * 12, covariance=[[0.0] * 12] * 12, coverage_factor=2.0, determined=[True] * 12,
        method="m", uncertainty_kind="type A, white", windows=1, residual_sd=[0.0] * 3, output_unit="count",
        identity="A",
    )  # fmt: skip
    kept = StoredResult.of(update, recorded=False, recording="")
    assert (kept.what, kept.identity, kept.sequence, kept.t_utc_ns) == ("calibration", "A", 4, 5)
    assert kept.fields["recorded"] is False
    assert kept.fields["sensitivity"][0] == [None] * 3
    change = StatusChange(run_id="r", sequence=5, sensor="mems", t_utc_ns=6, status="VALID", before="HELD", reason="")
    assert StoredResult.of(change, recorded=True, recording="f").what == "status"


def test_numbers_go_on_over_runs_and_jump_after_a_run_that_did_not_close(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    assert store.last_sequence() == 0
    store.commit([record(5)])
    store.close()
    store = Store(tmp_path, 0)
    assert store.last_sequence() == 5
    os.close(store._lock)  # a killed process lets go of its lock and does no more
    after_kill = Store(tmp_path, 0)
    assert after_kill.last_sequence() == 5 + UNKEPT_MAX
    after_kill.close()
    closed_well = Store(tmp_path, 0)
    assert closed_well.last_sequence() == 5 + UNKEPT_MAX
    closed_well.close()


def test_a_new_store_counts_on_from_the_clock_beyond_all_that_was_used_before(tmp_path: Path) -> None:
    before = time.time_ns() // 1_000_000
    store = Store(tmp_path)
    assert before <= store.last_sequence() <= before + 60_000
    assert store.published() == store.last_sequence()
    store.close()


def test_a_number_that_does_not_rise_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(5)])
    with pytest.raises(StoreError, match="result 5 does not come after result 5"):
        store.commit([record(5)])
    store.close()


def test_the_outbox_is_what_comes_after_the_published_mark(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(1), record(2)])
    store.mark_published(1)
    store.mark_published(0)
    assert store.published() == 1
    store.close()
    store = Store(tmp_path, 0)
    assert store.published() == 1
    store.close()


def test_a_commit_is_synced_into_a_log(tmp_path: Path) -> None:
    # What a power cut leaves cannot be tried here; SQLite promises durability for just this pair.
    store = Store(tmp_path, 0)
    settings = [store._connection.execute(f"PRAGMA {name}").fetchone() for name in ("journal_mode", "synchronous")]
    assert settings == [("wal",), (2,)]
    store.close()


def test_one_process_has_the_store_and_the_next_gets_one_clear_line(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    with pytest.raises(StoreError, match="another process is using it"):
        Store(tmp_path, 0)
    store.close()
    store.close()
    Store(tmp_path, 0).close()


_WRITER = """
import sys, json
from pathlib import Path
from agent.delivery.store import Store
from tests.unit.test_store import record
store = Store(Path(sys.argv[1]), 0)
n = store.last_sequence()
while True:
    n += 1
    store.commit([record(n, "calibration"), record(n + 1)])
    n += 1
    print(n, flush=True)
"""


@pytest.mark.slow
def test_a_committed_result_survives_kill_9_at_any_moment(tmp_path: Path) -> None:
    chance = random.Random(355)
    said = 0
    for _ in range(5):  # tests/faults kills 454 times
        writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(tmp_path)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        for _ in range(chance.randrange(1, 40)):
            said = int(writer.stdout.readline())
        time.sleep(chance.uniform(0, 0.002))  # anywhere within a commit
        writer.send_signal(signal.SIGKILL)
        said = max([said, *map(int, writer.stdout.read().split()[:-1])])
        writer.wait()
        writer.stdout.close()
        with History(tmp_path / FILE_NAME) as history:
            calibration = history.in_force("mems")
            kept = sequences(history.after(0, limit=10**6))
        assert kept[-1] >= said
        assert len(kept) % 2 == 0, "a transaction was torn"
        assert calibration is not None
        assert calibration.sequence == kept[-1] - 1
    store = Store(tmp_path, 0)
    assert store.set_aside is None
    store.close()


@pytest.mark.parametrize("damage", ["not a database", "a page overwritten", "cut"])
def test_a_corrupt_file_is_set_aside_with_its_log_and_numbers_stay_unused(tmp_path: Path, damage: str) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(n, payload=b"x" * 900) for n in range(1, 200)])
    store.close()
    path = tmp_path / FILE_NAME
    content = bytearray(path.read_bytes())
    if damage == "not a database":
        content[:16] = b"garbage, no more"
    elif damage == "a page overwritten":
        content[4096 * 5 : 4096 * 7] = os.urandom(8192)
    else:
        del content[len(content) // 2 // 4096 * 4096 :]
    path.write_bytes(content)
    (tmp_path / (FILE_NAME + "-wal")).write_bytes(b"a log")

    store = Store(tmp_path)
    assert store.set_aside == tmp_path / "state.sqlite.corrupt-1"
    assert store.set_aside.read_bytes() == content
    assert (tmp_path / "state.sqlite-wal.corrupt-1").read_bytes() == b"a log"
    assert store.last_sequence() > 1_600_000_000_000
    store.commit([record(store.last_sequence() + 1)])
    store.close()
    path.write_bytes(b"garbage again, longer than a header" * 9)
    assert Store(tmp_path, 0).set_aside == tmp_path / "state.sqlite.corrupt-2"


def test_a_store_of_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    Store(tmp_path, 0).close()
    connection = sqlite3.connect(tmp_path / FILE_NAME)
    connection.execute("CREATE TABLE of_a_later_version (x)")
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="version 99"):
        Store(tmp_path, 0)
    with pytest.raises(StoreError, match="version 99"):
        History(tmp_path / FILE_NAME)
    assert not list(tmp_path.glob("*corrupt*"))


def test_a_full_disk_is_said_and_what_it_refused_is_kept_when_there_is_room(tmp_path: Path) -> None:
    store = Store(tmp_path, 0)
    store.commit([record(1)])
    (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreError, match="full"):
        store.commit([record(2, payload=b"x" * 20_000)])
    with History(store.path) as history:
        assert sequences(history.after(0, limit=9)) == [1]
        store._connection.execute("PRAGMA max_page_count = 100000")
        store.commit([record(3)])
        assert sequences(history.after(0, limit=9)) == [1, 2, 3]
    store.close()


def test_a_directory_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        Store(tmp_path / "file" / "data")


def test_no_store_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such file"):
        History(tmp_path / FILE_NAME)


def test_a_directory_that_cannot_be_written_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever may only read cannot make the files beside the store that SQLite wants for it."""
    Store(tmp_path, 0).close()
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setattr("agent.delivery.history.os.access", lambda *_: False)
    with closing(connect_read_only(tmp_path / FILE_NAME)) as connection:
        assert connection.execute("select count(*) from sqlite_master").fetchone()[0] > 0
        assert sorted(path.name for path in tmp_path.iterdir()) == before
