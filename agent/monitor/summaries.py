"""What is kept of older results: hourly summaries, made in steps by a thread of the monitor.

Of each hour the last calibration and the last estimate stay, and of each day the first one, which has the budget; all
without their covariances. So do the counts. The newest result of each kind stays as it is, and so do all results of
kinds that a person may have to read.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import zlib
from collections.abc import Callable
from typing import Any

import msgspec

from agent.monitor.engines import LASTING, DatabaseError, QueryRunner

FULL_DAYS = 7  # days for which every result is kept in full
# Results of these kinds come by schedule. All others (status, drift verdicts, kinds of a newer version) stay in full.
# Of `watch` nothing is counted: its hours are kept apart (agent.monitor.watch_store).
SUMMARISED = ("calibration", "estimate", "window", "clock", "watch")
COUNTS = {
    "calibrations": "what = 'calibration'",
    "estimates": "what = 'estimate'",
    "windows_used": "part = 'used'",
    "windows_refused": "part = 'refused'",
    "clocks": "what = 'clock'",
}
DETAIL = ("covariance", "response", "sensitivity_at_0hz")  # of a calibration, left out of summaries
SHARED_DETAIL = ("derivative", "own_derivative")  # of each of its shared errors, likewise
PAUSE_S = 0.02  # s between two steps, in which results are taken
LOOK_S = 60.0  # s between two looks for a day to summarise

_log = logging.getLogger(__name__)


class Summariser:
    """A thread that calls `step` until it returns False, and again each LOOK_S, until `close`."""

    def __init__(self, step: Callable[[], bool]) -> None:
        self._step = step
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="summariser", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread after the step that it is at."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        more = True
        while not self._stop.wait(PAUSE_S if more else LOOK_S):
            try:
                more = self._step()
            except (sqlite3.Error, DatabaseError) as error:
                _log.warning("monitor: older results are not summarised: %s", error)
                more = False


def summarise(run: QueryRunner, day: int, sensor: int) -> None:
    """Count the results of a sensor on a day by the hour, and set apart what stays of them."""
    names, of = ", ".join(COUNTS), {"sensor": sensor, "day": day}
    run(
        f"INSERT INTO summary (sensor, hour, {names}) SELECT sensor, hour,"
        f" {', '.join(f'sum(CASE WHEN {holds} THEN 1 ELSE 0 END)' for holds in COUNTS.values())}"
        " FROM result WHERE sensor = :sensor AND day = :day GROUP BY sensor, hour ON CONFLICT (sensor, hour) DO UPDATE"
        f" SET {', '.join(f'{name} = summary.{name} + excluded.{name}' for name in COUNTS)}",
        **of,
    )
    newest = "(SELECT number FROM newest WHERE sensor = :sensor)"
    # A detail that is NULL is that of the calibration before, which does not stay.
    run(
        "UPDATE result SET detail = (SELECT b.detail FROM result b WHERE b.sensor = result.sensor AND"
        " b.what = result.what AND b.day = result.day AND b.number < result.number AND b.detail IS NOT NULL"
        " ORDER BY b.number DESC LIMIT 1)"
        f" WHERE sensor = :sensor AND day = :day AND number IN {newest} AND detail IS NULL",
        **of,
    )
    run(
        f"UPDATE result SET day = {LASTING}, detail = CASE WHEN number IN {newest} THEN detail END"
        f" WHERE sensor = :sensor AND day = :day AND (number IN {newest} OR number IN"
        " (SELECT max(number) FROM result WHERE sensor = :sensor AND day = :day"
        " AND what IN ('calibration', 'estimate') GROUP BY what, hour UNION SELECT min(number) FROM result WHERE"
        " sensor = :sensor AND day = :day AND what IN ('calibration', 'estimate') GROUP BY what))",
        **of,
    )


def split(what: str, fields: dict[str, Any]) -> tuple[dict[str, Any], bytes | None]:
    """The fields of a result without its detail, and the detail, packed; None where it has none."""
    if what not in ("calibration", "estimate"):
        return fields, None
    held = fields["calibration"] if what == "estimate" else fields
    shared = held.get("shared_errors", [])
    short = {name: value for name, value in held.items() if name not in DETAIL}
    short["shared_errors"] = [{name: e[name] for name in e if name not in SHARED_DETAIL} for e in shared]
    detail = {name: held[name] for name in DETAIL if name in held}
    detail["shared_errors"] = [{name: e[name] for name in SHARED_DETAIL if name in e} for e in shared]
    return (short if held is fields else fields | {"calibration": short}), packed(detail)


def merged(what: str, fields: dict[str, Any], detail: bytes | None) -> dict[str, Any]:
    """The fields with their detail again."""
    if detail is None:
        return fields
    found = unpacked(detail)
    held = fields["calibration"] if what == "estimate" else fields
    shared = [a | b for a, b in zip(held["shared_errors"], found["shared_errors"], strict=True)]
    whole = held | found | {"shared_errors": shared}
    return whole if held is fields else fields | {"calibration": whole}


def packed(fields: dict[str, Any]) -> bytes:
    """JSON, compressed."""
    return zlib.compress(msgspec.json.encode(fields))


def unpacked(data: bytes) -> dict[str, Any]:
    """The JSON object again."""
    return msgspec.json.decode(zlib.decompress(data), type=dict[str, Any])
