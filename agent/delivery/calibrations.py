"""The calibrations of a sensor, each once, however often it came into force."""

from __future__ import annotations

from agent.delivery.history import History, StoredResult


def first_in_force(record: StoredResult) -> tuple[str, int]:
    """(run, sequence) of the result by which the calibration of this record first came into force."""
    fields = record.fields
    sequence = fields.get("made_sequence")
    return (str(fields.get("made_run_id")), int(sequence)) if sequence else (record.run_id, record.sequence)


def date_utc_ns(record: StoredResult) -> int:
    """When the calibration of this record was made."""
    return int(record.fields.get("made_utc_ns") or record.t_utc_ns)


def calibrations(history: History, sensor: str, *, limit: int) -> list[StoredResult]:
    """The newest `limit` calibrations of a sensor, newest first by when they were made.

    Each is the record of when it was made; of one that retention deleted, the record by which it came into force last.
    """
    asked = limit
    while True:
        records = history.newest(sensor, "calibration", limit=asked)
        once: dict[tuple[str, int], StoredResult] = {}
        for record in records:
            once.setdefault(first_in_force(record), record)
        if len(once) >= limit or len(records) < asked:
            break
        asked *= 2
    newest = sorted(once.values(), key=date_utc_ns, reverse=True)[:limit]
    return [_first(history, record) for record in newest]


def _first(history: History, record: StoredResult) -> StoredResult:
    run_id, sequence = first_in_force(record)
    found = history.after(sequence - 1, [(record.sensor, "calibration")], limit=1)
    there = bool(found) and (found[0].run_id, found[0].sequence) == (run_id, sequence)
    return found[0] if there else record
