"""What the recordings know and the store does not: all of it after a store was lost, the end after a crash."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from agent.delivery.history import Record
from agent.delivery.schema import RESULT_COLUMNS, checked, insert_results, withdraw, write_latest
from agent.recording.files import FILE_METADATA, final_name, recordings
from agent.recording.scan import scan

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Recovered:
    """How many results came back, from how many files; the marks that the newest file names."""

    results: int = 0
    files: int = 0
    file_sequence: int = 0
    published: int = 0


def recover(connection: sqlite3.Connection, directory: Path, *, everything: bool) -> Recovered:
    """Add the recorded results that the store lacks; within the caller's transaction.

    Goes back from the newest file to the first from which nothing is missing, or through all where `everything` is
    wanted. Raises sqlite3.Error, DamagedRow; files that cannot be read are told and left out.
    """
    recovered = Recovered()
    rows = connection.execute("SELECT sensor, what, count, up_to, crc FROM removed")
    removed = {(row[0], row[1]): row[3] for row in map(checked, rows)}
    for number, path in reversed(recordings(directory)):
        try:
            found = scan(path)
        except OSError as error:
            _log.warning("%s: cannot be read, its results are not found again: %s", path, error.strerror)
            continue
        for fault in found.faults:
            _log.warning("%s: results are not found again: %s", path, fault)
        if not recovered.file_sequence:
            recovered.file_sequence = number
            recovered.published = _published(found.metadata.get(FILE_METADATA, {}))
        records = [Record.of(result, recorded=True, recording=final_name(path)) for result in found.results]
        missing = [r for r in _missing(connection, records) if r.sequence > removed.get((r.sensor, r.what), 0)]
        insert_results(connection, [record.row for record in missing])
        recovered.results += len(missing)
        recovered.files += bool(missing)
        if found.results and not missing and not everything:
            break
    if recovered.results:
        name_latest(connection)
    return recovered


def name_latest(connection: sqlite3.Connection) -> None:
    """Name the newest result of every channel anew, and the calibrations that are in force no more."""
    newest = "SELECT sensor, what, max(sequence) FROM results GROUP BY sensor, what"
    calibrations: dict[str, int] = {}
    for sensor, what, sequence in connection.execute(newest).fetchall():
        write_latest(connection, sensor, what, sequence, withdrawn=False)
        if what == "calibration":
            calibrations[sensor] = sequence
    since = f"SELECT {RESULT_COLUMNS}, crc FROM results WHERE sensor = ? AND what = 'status' AND sequence > ?"
    for sensor, sequence in calibrations.items():
        statuses = map(Record.of_row, connection.execute(since, (sensor, sequence)))
        if any(status.is_withdrawal for status in statuses):
            withdraw(connection, sensor)


def _missing(connection: sqlite3.Connection, records: Iterable[Record]) -> list[Record]:
    missing = []
    for record in records:
        row = connection.execute("SELECT 1 FROM results WHERE sequence = ?", (record.sequence,)).fetchone()
        if row is None:
            missing.append(record)
    return missing


def _published(metadata: dict[str, str]) -> int:
    """The mark as it stood when a file began; 0 where it does not say: results go out twice rather than never."""
    text = metadata.get("published", "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0
