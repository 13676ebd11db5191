"""Restores from the recordings what the store lacks: everything after the store was lost, the end after a crash."""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.core.memory import Memory
from agent.delivery.history import Record
from agent.delivery.schema import (
    RESULT_COLUMNS,
    checked,
    insert_results,
    insert_signed,
    withdraw,
    write_latest,
    write_memory,
)
from agent.recording.files import final_name, recordings
from agent.recording.reading import first_event
from agent.recording.result_signing import PUBLIC_KEY, recorded_result
from agent.recording.results_chain import EPOCH, FILE_METADATA
from agent.recording.scan import ScannedFile, scan

_log = logging.getLogger(__name__)

Recall = Callable[[Path], Sequence[Memory]]  # gives the states of the estimation at the end of a recording
# s; after this time no further recording is replayed at a start. One replay takes seconds for an hour of recording.
LONGEST_S = 60.0


@dataclass(slots=True)
class Recovered:
    """What was restored: `results` from `files` recordings, states (`memories`) of so many devices.

    `file_sequence`, `published`: number of the newest recording, and the last published result when it began.
    """

    results: int = 0
    memories: int = 0
    files: int = 0
    file_sequence: int = 0
    published: int = 0


def recover(connection: sqlite3.Connection, directory: Path, *, everything: bool) -> Recovered:
    """Add the recorded results that the store lacks, within the caller's transaction.

    Reads the recordings from the newest one back to the first of which no result is missing; all of them with
    `everything`. A file that cannot be read is skipped, with a warning in the log. Raises sqlite3.Error, DamagedRow.
    """
    recovered = Recovered()
    rows = connection.execute("SELECT sensor, what, count, up_to, crc FROM removed")
    removed = {(row[0], row[1]): row[3] for row in map(checked, rows)}
    for number, path in reversed(recordings(directory)):
        try:
            found = scan(path)
        except OSError as error:
            _log.warning("%s: cannot be read, its results are not restored to the store: %s", path, error.strerror)
            continue
        for fault in found.faults:
            _log.warning("%s: some results are not restored to the store: %s", path, fault)
        if not recovered.file_sequence and first_event(path) is not None:  # without it the number is used again
            recovered.file_sequence = number
            recovered.published = _published(found.metadata.get(FILE_METADATA, {}))
        records = _records(path, found)
        missing = [r for r in _missing(connection, records) if r.sequence > removed.get((r.sensor, r.what), 0)]
        insert_results(connection, [record.row for record in missing])
        insert_signed(connection, _signed(path, found, {record.sequence for record in missing}))
        recovered.results += len(missing)
        recovered.files += bool(missing)
        if found.results and not missing and not everything:
            break
    if recovered.results:
        name_latest(connection)
    return recovered


def _records(path: Path, found: ScannedFile) -> list[Record]:
    epoch = found.metadata.get(FILE_METADATA, {}).get(EPOCH, "")
    return [Record.of(r, recorded=True, recording=final_name(path), epoch=epoch) for r in found.results]


def _signed(path: Path, found: ScannedFile, sequences: set[int]) -> list[tuple[int, bytes]]:
    """(sequence, signed result) of these results of a recording. Signatures are not verified: consumers do that."""
    origin = found.metadata.get(FILE_METADATA, {})
    start = first_event(path) if sequences and PUBLIC_KEY in origin else None
    if start is None:
        return []
    each = zip(found.results, found.messages, strict=True)
    signed = [recorded_result(*one, f"{start.site}/{start.gateway}", origin) for one in each]
    return [(one.sequence, one.data) for one in signed if one and one.sequence in sequences and one.is_written]


def recover_memories(connection: sqlite3.Connection, directory: Path, recall: Recall) -> int:
    """Update the states of the estimation from the recordings, within the caller's transaction.

    The newest recording gives the states of all devices of its run and those kept from before. Then follow, newest
    first, the recordings with a calibration that is newer than the state known of its device.
    Returns the number of devices whose state was replaced.
    """
    rows = connection.execute("SELECT sensor, identity, sequence, state, crc FROM memory")
    known: dict[tuple[str, str], int] = {(row[0], row[1]): row[2] for row in map(checked, rows)}
    files = {final_name(path): path for _, path in recordings(directory)}
    end = time.monotonic() + LONGEST_S
    found: set[tuple[str, str]] = set()

    def take(name: str) -> None:
        path = files.pop(name, None)
        for memory in recall(path) if path is not None and time.monotonic() < end else ():
            device = (memory.sensor, memory.identity)
            if memory.sequence > known.get(device, 0):
                write_memory(connection, (*device, memory.sequence, memory.state))
                known[device] = memory.sequence
                found.add(device)

    take(next(reversed(files), ""))
    for sensor, identity, name, sequence in connection.execute(_CALIBRATED).fetchall():
        if known.get((sensor, identity), 0) < sequence:
            take(name)
    return len(found)


_CALIBRATED = """
SELECT sensor, identity, recording, max(sequence) AS newest FROM results
WHERE what = 'calibration' AND recorded = 1 GROUP BY sensor, identity, recording ORDER BY newest DESC"""


def no_memories(_: Path) -> Sequence[Memory]:
    """A Recall that replays nothing and gives no states."""
    return ()


def name_latest(connection: sqlite3.Connection) -> None:
    """Write the table `latest` anew: the newest result of every channel; mark calibrations no longer in force."""
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
    """The last published result when a recording began; 0 where unknown: better published twice than never."""
    text = metadata.get("published", "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0
