"""Signed results in the store: kept byte for byte, brought back from recordings, deleted with their results."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from agent.delivery.history import FILE_NAME, History, StoreError
from agent.delivery.retention import KeepResults
from agent.delivery.store import Store
from agent.recording.files import recordings
from agent.recording.result_signing import SignedResult
from agent.recording.scan import scan
from tests.attacks.chain_site import KEY, audited
from tests.attacks.chain_site import record as record_run
from tests.attacks.signed_site import signed_record, signer_of
from tests.replay.forgery import change_messages
from tests.unit.results import window


def fill(directory: Path, count: int, keep: KeepResults | None = None) -> list[bytes]:
    store = Store(directory, 0, keep or KeepResults())
    signer = signer_of("site/gw", store.epoch, KEY)
    records = [signed_record(window(n + 1), signer, store.epoch) for n in range(count)]
    for record in records:
        store.commit([record])
        store.mark_published(record.sequence)
    store.close()
    return [record.signed for record in records]


def test_what_was_signed_is_read_again_byte_for_byte(tmp_path: Path) -> None:
    signed = fill(tmp_path, 4)
    with History(tmp_path / FILE_NAME) as history:
        assert [record.signed for record in history.after(0, limit=9)] == signed
        assert history.latest()[0].signed == signed[-1]
        history.check()


def test_a_changed_byte_of_a_signed_result_is_damage(tmp_path: Path) -> None:
    fill(tmp_path, 2)
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection, connection:
        connection.execute("UPDATE signed SET data = CAST(data || x'00' AS BLOB) WHERE sequence = 2")
    with History(tmp_path / FILE_NAME) as history:
        assert len(history.after(0, limit=1)) == 1
        with pytest.raises(StoreError, match="its CRC does not fit"):
            history.after(1, limit=1)
        with pytest.raises(StoreError, match="its CRC does not fit"):
            history.check()


def test_retention_deletes_it_with_its_result(tmp_path: Path) -> None:
    fill(tmp_path, 9, KeepResults(bytes=1))
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection:
        left = [connection.execute(f"SELECT sequence FROM {table}").fetchall() for table in ("results", "signed")]
    assert left[0] == left[1]
    assert 1 <= len(left[0]) < 9


def test_a_store_of_version_3_takes_signed_results_after_its_migration(tmp_path: Path) -> None:
    fill(tmp_path, 2)
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection, connection:
        connection.execute("DROP TABLE signed")
        connection.execute("DROP TABLE states")
        connection.execute("PRAGMA user_version = 3")
    with pytest.raises(StoreError, match="`fieldcal run` brings it up to date"):
        History(tmp_path / FILE_NAME)
    store = Store(tmp_path)
    assert store.set_aside is None
    record = signed_record(window(9), signer_of("site/gw", store.epoch, KEY), store.epoch)
    store.commit([record])
    store.close()
    with History(tmp_path / FILE_NAME) as history:
        assert [r.signed for r in history.after(0, limit=9)] == [b"", b"", record.signed]


def test_a_lost_store_gets_the_signed_results_of_the_recordings(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    record_run(directory)
    for path in directory.glob("state.sqlite*"):
        path.unlink()
    stored = [message for _, path in recordings(directory) for message in scan(path).messages]
    store = Store(directory)
    with History(store.path) as history:
        records = history.after(0, limit=99)
    store.close()
    read = [SignedResult.read(record.signed) for record in records]
    assert [signed.message for signed in read] == stored
    assert {(signed.gateway, signed.fault) for signed in read} == {("site/gateway", "")}
    assert [signed.sequence for signed in read] == [record.sequence for record in records]


def test_names_of_several_lines_in_a_recording_harm_no_store(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    files = record_run(directory, blocks=3)
    change_messages(files[0], b"site", b"s\nte")
    for path in directory.glob("state.sqlite*"):
        path.unlink()
    store = Store(directory)
    with History(store.path) as history:
        records = history.after(0, limit=99)
    store.close()
    assert len(records) == len(scan(files[0]).results) > 0
    assert {record.signed for record in records} == {b""}
    status, text = audited(directory, keys=None, strict=False)
    assert (status, "it is not signed" in text) == (3, True), text
