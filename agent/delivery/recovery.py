"""Restores from the recordings what the store lacks: everything after the store was lost, the end after a crash."""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.delivery.gateway_key import GatewayKey
from agent.delivery.proof import UnprovenError, proven
from agent.delivery.record import JOINED, StoredResult
from agent.delivery.schema import (
    RESULT_COLUMNS,
    checked,
    insert_results,
    insert_signed,
    withdraw,
    write_latest,
)
from agent.recording.covered import digest_is_signed
from agent.recording.files import final_name, recordings
from agent.recording.reading import first_event
from agent.recording.result_signing import PUBLIC_KEY, recorded_result
from agent.recording.results_chain import EPOCH, FILE_METADATA
from agent.recording.scan import ScannedFile, scan

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

LOOK_S = 3.0  # s that a result is looked for in the recordings; who sent a command waits 5 s for the answer

_log = logging.getLogger(__name__)


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


def recover(connection: sqlite3.Connection, directory: Path, keys: KnownKeys | None, *, everything: bool) -> Recovered:
    """Add the recorded results that the store lacks, within the caller's transaction.

    Reads the recordings from the newest one back to the first of which no result is missing; all of them with
    `everything`. With `keys`, one of them must have signed a result that names a key. A file that cannot be read is
    skipped, with a warning in the log. Raises sqlite3.Error, DamagedRow.
    """
    recovered = Recovered()
    rows = connection.execute("SELECT sensor, what, count, up_to, crc FROM removed")
    removed = {(row[0], row[1]): row[3] for row in map(checked, rows)}
    for number, path in reversed(recordings(directory)):
        if (found := _scan(path)) is None:
            continue
        if not recovered.file_sequence and first_event(path) is not None:  # without it the number is used again
            recovered.file_sequence = number
            recovered.published = _last_published(found.metadata.get(FILE_METADATA, {}))
        missing = _missing(connection, records_of(path, found))
        missing = [r for r in missing if r.sequence > removed.get((r.sensor, r.what), 0) and _counts(path, r, keys)]
        insert_results(connection, [record.row for record in missing])
        insert_signed(connection, [(record.sequence, record.signed) for record in missing if record.signed])
        recovered.results += len(missing)
        recovered.files += bool(missing)
        if found.results and not missing and not everything:
            break
    return recovered


def _scan(path: Path) -> ScannedFile | None:
    """The file; None where it cannot be read. What of it cannot be used is in the log."""
    try:
        found = scan(path)
    except OSError as error:
        _log.warning("%s: cannot be read, its results are not restored to the store: %s", path, error.strerror)
        return None
    for fault in found.faults:
        _log.warning("%s: some results are not restored to the store: %s", path, fault)
    return found


def records_of(path: Path, found: ScannedFile) -> list[StoredResult]:
    """The results of a scanned recording, with their signatures, which are not verified."""
    origin = found.metadata.get(FILE_METADATA, {})
    start = first_event(path) if PUBLIC_KEY in origin else None
    gateway = f"{start.site}/{start.gateway}" if start is not None else ""
    records = []
    for result, message in zip(found.results, found.messages, strict=True):
        signed = recorded_result(result, message, gateway, origin) if start is not None else None
        data = signed.data if signed is not None and signed.is_written else b""
        records.append(
            StoredResult.of(result, recorded=True, recording=final_name(path), epoch=origin.get(EPOCH, ""), signed=data)
        )
    return records


def find_recorded(directory: Path, name: str, sequence: int, key: GatewayKey) -> StoredResult | None:
    """A result in the recordings, first looked for in the one with this name; None where there is none within LOOK_S.

    The key must have signed it, or a recording that names the SHA-256 of its recording. Raises OSError.
    """
    end_s = time.monotonic() + LOOK_S
    for path in sorted(
        (path for _, path in reversed(recordings(directory))), key=lambda path: final_name(path) != name
    ):
        if time.monotonic() > end_s:
            return None
        for record in records_of(path, scan(path)):
            if record.sequence != sequence:
                continue
            if record.signed and _counts(path, record, key.known_keys):
                return record
            if not record.signed and digest_is_signed(path, key.gateway, key.known_keys):
                return record
    return None


def check_newest(connection: sqlite3.Connection, directory: Path, key: GatewayKey) -> list[str]:
    """Check the newest result of each channel, as `check_row`; returns what is told.

    Raises sqlite3.Error, DamagedRow, OSError.
    """
    (first,) = connection.execute("SELECT coalesce(min(sequence), 0) FROM signed").fetchone()
    newest = connection.execute("SELECT sequence FROM latest WHERE sequence > ?", (first,)).fetchall()
    told = [check_row(connection, directory, sequence, key) for (sequence,) in newest] if first else []
    return [fault for fault in told if fault]


def check_row(connection: sqlite3.Connection, directory: Path, sequence: int, key: GatewayKey) -> str:
    """Make the row of a result anew where it is not what the key signed, within the caller's transaction.

    Returns what is told of it; "" where the row is right, or is unsigned and the same as in the recordings. Raises
    sqlite3.Error, DamagedRow, OSError.
    """
    record = StoredResult.of_joined(connection.execute(f"{JOINED} WHERE sequence = ?", (sequence,)).fetchone())
    right, reason = None, "it is not signed"
    if record.signed:
        try:
            right, reason = proven(record, key.known_keys)
        except UnprovenError as error:
            reason = str(error)
    if not reason:
        return ""
    right = right or find_recorded(directory, record.recording, sequence, key)
    if right is not None and right.payload == record.payload and not (right.signed or record.signed):
        return ""
    told = f"{record.what} {sequence} in the store is not what this gateway signed: {reason}"
    if right is None:
        return f"{told}; no recording has it"
    for table in ("results", "signed"):
        connection.execute(f"DELETE FROM {table} WHERE sequence = ?", (sequence,))
    insert_results(connection, [right.row])
    insert_signed(connection, [(sequence, right.signed)] if right.signed else [])
    return f"{told}; it was made anew from what is signed: send a command that names it again"


def _counts(path: Path, record: StoredResult, keys: KnownKeys | None) -> bool:
    """Whether a result of a recording may be in the store."""
    if keys is None or not record.signed:
        return True
    try:
        proven(record, keys)
    except UnprovenError as error:
        _log.warning("%s: result %d is not restored to the store: %s", path, record.sequence, error)
        return False
    return True


def name_latest(connection: sqlite3.Connection) -> None:
    """Write the table `latest` anew: the newest result of every channel; mark calibrations no longer in force."""
    # Retention may have deleted the status by which a calibration was withdrawn.
    withdrawn = connection.execute("SELECT sensor, sequence FROM latest WHERE withdrawn = 1").fetchall()
    connection.execute("DELETE FROM latest")
    newest = "SELECT sensor, what, max(sequence) FROM results GROUP BY sensor, what"
    calibrations: dict[str, int] = {}
    for sensor, what, sequence in connection.execute(newest).fetchall():
        write_latest(connection, sensor, what, sequence, withdrawn=False)
        if what == "calibration":
            calibrations[sensor] = sequence
    since = f"SELECT {RESULT_COLUMNS}, crc FROM results WHERE sensor = ? AND what = 'status' AND sequence > ?"
    for sensor, sequence in calibrations.items():
        statuses = map(StoredResult.of_row, connection.execute(since, (sensor, sequence)))
        if (sensor, sequence) in withdrawn or any(status.is_withdrawal for status in statuses):
            withdraw(connection, sensor)


def _missing(connection: sqlite3.Connection, records: Iterable[StoredResult]) -> list[StoredResult]:
    missing = []
    for record in records:
        row = connection.execute("SELECT 1 FROM results WHERE sequence = ?", (record.sequence,)).fetchone()
        if row is None:
            missing.append(record)
    return missing


def _last_published(metadata: dict[str, str]) -> int:
    """The last published result when a recording began; 0 where unknown: better published twice than never."""
    text = metadata.get("published", "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0
