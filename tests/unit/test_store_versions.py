"""A store of version 1, as that version left it, is brought up to date whole or not at all."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest

from agent.core.events import CalibrationUpdate
from agent.delivery.history import FILE_NAME, History, StoreError
from agent.delivery.schema import row_crc
from agent.delivery.store import Store

VERSION_1 = Path(__file__).parent / "stores" / "version-1.sqlite"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A data directory's store: ten results, of which 4 and 7 are calibrations of chip 1, 9 of chip 2."""
    return Path(shutil.copy(VERSION_1, tmp_path / FILE_NAME))


def raw(path: Path) -> list[tuple[object, ...]]:
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    rows = connection.execute(
        "SELECT sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity"
        " FROM results ORDER BY sequence"
    ).fetchall()
    connection.close()
    return rows


def test_all_is_there_after_it_and_the_numbers_go_on(path: Path) -> None:
    before = raw(path)
    store = Store(path.parent)
    assert store.set_aside is None
    assert (store.last_sequence(), store.published(), store.file_sequence()) == (10, 8, 0)
    with History(path) as history:
        records = history.after(0, limit=100)
        assert [r.sequence for r in history.latest()] == [6, 9, 10]
        in_force = history.in_force("mems")
        assert in_force is not None
        assert isinstance(in_force.result, CalibrationUpdate)
        assert in_force.result.sensitivity[0][0] == 26001.0
        assert sorted(r.sequence for r in history.calibrations("mems").values()) == [7, 9]
    store.close()
    assert raw(path) == before
    assert [(*row, row_crc(*row)) for row in before] == [r.row for r in records]
    Store(path.parent).close()


def test_a_calibration_that_was_withdrawn_stays_so(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.execute("DELETE FROM results WHERE sequence >= 9")
    connection.execute("UPDATE latest SET sequence = 7 WHERE what = 'calibration'")
    connection.execute("UPDATE latest SET sequence = 8 WHERE what = 'status'")
    connection.commit()
    connection.close()
    Store(path.parent).close()
    with History(path) as history:
        assert history.in_force("mems") is None
        assert [r.sequence for r in history.latest()] == [6, 8]


@pytest.mark.parametrize("statement", range(0, 24, 2))
def test_a_migration_that_is_interrupted_leaves_the_old_version(
    path: Path, statement: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = 0

    class Interrupted(sqlite3.Connection):
        def execute(self, sql: str, *arguments: object) -> sqlite3.Cursor:
            nonlocal count
            if self.in_transaction:
                count += 1
                if count == statement + 1:
                    error = sqlite3.OperationalError("the disk is full")
                    error.sqlite_errorcode = sqlite3.SQLITE_FULL
                    raise error
            return super().execute(sql, *arguments)  # type: ignore[arg-type]

    before = raw(path)
    connect = sqlite3.connect
    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", lambda *a, **k: connect(*a, factory=Interrupted, **k))
        with pytest.raises(StoreError, match="the disk is full"):
            Store(path.parent)
    assert raw(path) == before
    store = Store(path.parent, 0)
    assert (store.set_aside, store.published()) == (None, 8)
    store.close()
    assert raw(path) == before


def test_a_reader_says_who_brings_it_up_to_date(path: Path) -> None:
    with pytest.raises(StoreError, match=r"version 1, .* version 5; `fieldcal run` brings it up to date"):
        History(path)
