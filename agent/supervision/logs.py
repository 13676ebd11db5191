"""The log of a run as JSON, one object a line on standard error: for journals and what reads them.

Everything that reaches standard error goes this way, from our own words to a library's warning. The logger `fieldcal`
tells what happens (devices, gaps, results, state); the terminal shows that in its own way. `agent.*` tells troubles.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import queue
import re
import sys
import threading
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import msgspec

from agent.core.events import Command, DeviceChange, Event, Gap, Pruned, Result, SelfTestRun
from agent.terminal.wording import gap_line, result_lines

_JOURNAL = logging.getLogger("fieldcal")
WAITING_MAX = 1000  # lines; a journal that hangs costs lines, which are counted, and never a sample
CLOSE_S = 0.5
LONGEST = 8192  # characters of a message; journald cuts a line at 48 KiB
LEFT_OUT = frozenset({"run_id", "covariance", "calibration", "numbers", "calibration_json"})  # stands in the store

# Bounded everywhere: a line that somebody else made must not cost seconds.
_SECRETS = [
    (re.compile(r"-----BEGIN ([A-Z ]*PRIVATE KEY)-----.*?(-----END \1-----|\Z)", re.DOTALL), "[removed]"),
    # A Zenoh endpoint may carry keys and passwords behind its '#'.
    (re.compile(r"\b((?:tcp|udp|tls|quic|ws|wss|serial)/[^\s,#'\"]{1,300})#[^\s,'\"]+"), r"\1#[removed]"),
    (re.compile(r"\b([a-z][a-z0-9+.-]{1,20}://[^\s/:@]{1,100}):[^\s/@]{1,300}@", re.IGNORECASE), r"\1:[removed]@"),
    (
        re.compile(
            r"((?:password|passwd|secret|token|private[_-]?key\w{0,40})[\"']?\s*[:=]\s*)(\"[^\"]*\"|'[^']*'|[^\s,;}]+)",
            re.IGNORECASE,
        ),
        r"\1[removed]",
    ),
]


def under_journal(environment: Mapping[str, str], descriptor: int) -> bool:
    """Whether a descriptor leads to systemd's journal: JOURNAL_STREAM names its device and inode, systemd.exec(5)."""
    try:
        there = os.fstat(descriptor)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{there.st_dev}:{there.st_ino}"


def without_secrets(text: str) -> str:
    """The text with what looks like a private key or a password taken out."""
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return text


class JsonFormatter(logging.Formatter):
    """time (UTC), level, logger and message, then the record's own `fields`."""

    def format(self, record: logging.LogRecord) -> str:
        """One line without a line break."""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage()[:LONGEST],
        }
        if record.exc_info and record.exc_info[1] is not None:
            entry["exception"] = f"{type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
        return json.dumps(_clean(entry | getattr(record, "fields", {})))


class JsonLog(logging.Handler):
    """Writes records to a descriptor from a thread of its own. Never blocks, never raises; lost lines are counted."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(logging.INFO)
        self.setFormatter(JsonFormatter())
        self._descriptor = descriptor
        self._waiting: queue.Queue[logging.LogRecord | None] = queue.Queue(WAITING_MAX)
        self._lost = 0
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Hand a record over, or write it where the thread has ended."""
        if not self._thread.is_alive():
            self._write(record)
            return
        try:
            self._waiting.put_nowait(record)
        except queue.Full:
            self._lost += 1

    def finish(self) -> None:
        """Write what waits, as far as that goes in CLOSE_S; records that come later are written at once."""
        try:
            self._waiting.put(None, timeout=CLOSE_S)
        except queue.Full:
            return
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while (record := self._waiting.get()) is not None:
            lost, self._lost = self._lost, 0
            if lost:
                words = f"{lost} lines of the log were lost: nobody took them"
                self._write(logging.LogRecord(__name__, logging.WARNING, "", 0, words, (), None))
            self._write(record)

    def _write(self, record: logging.LogRecord) -> None:
        try:
            line = memoryview(f"{self.format(record)}\n".encode())
            while line:
                line = line[os.write(self._descriptor, line) :]
        except (OSError, ValueError, TypeError):
            return  # whoever read the log went away; the agent goes on


class _StandardError(io.TextIOBase):
    """Stands in for standard error: each line that is printed there becomes a record."""

    def __init__(self) -> None:
        self._rest = ""

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        *lines, self._rest = (self._rest + text).split("\n")
        for line in lines:
            if line.strip():
                logging.getLogger("stderr").error("%s", line)
        return len(text)


def log_as_json() -> JsonLog:
    """From now on all that this process tells on standard error is JSON, one object a line."""
    log = JsonLog(sys.stderr.fileno())
    root = logging.getLogger()
    root.addHandler(log)
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)
    logging.raiseExceptions = False
    sys.stderr = _StandardError()
    return log


def log_event(event: Event, results: Sequence[Result]) -> None:
    """What happened, with its fields."""
    if isinstance(event, DeviceChange):
        message = f"{event.device}: {event.state}, {event.message}"
        tell("device", message, event.state == "lost", device=event.device, state=event.state, attempt=event.attempt)
    elif isinstance(event, Gap):
        tell("gap", gap_line(event), True, device=event.device, dropped=event.dropped, unit=event.unit)
    elif isinstance(event, SelfTestRun) and event.state == "begun":
        tell("device", f"{event.device}: tests itself, and sends no samples", device=event.device, state="self-test")
    elif isinstance(event, Command):
        refused = f"refused: {event.refused}" if event.refused else "taken"
        tell("command", f"{event.sensor}: command {event.verb} {refused}", bool(event.refused), **_fields(event))
    elif isinstance(event, Pruned):
        message = f"recording {event.last_file} is deleted to keep to the limits"
        tell("pruned", message, first_file=event.first_file, last_file=event.last_file, bytes=event.bytes)
    for result in results:
        if not result.routine:
            tell(result.what, result_lines(result, None)[0], **_fields(result))


def tell(event: str, message: str, trouble: bool = False, **fields: Any) -> None:
    """One thing that happened, where somebody reads such things."""
    if _JOURNAL.isEnabledFor(logging.INFO):
        level = logging.WARNING if trouble else logging.INFO
        _JOURNAL.log(level, "%s", message, extra={"fields": {"event": event, **fields}})


def _fields(of: Command | Result) -> dict[str, Any]:
    return {name: value for name, value in msgspec.structs.asdict(of).items() if name not in LEFT_OUT}


def _clean(value: Any) -> Any:
    """What JSON can hold: no NaN, no half of a surrogate pair; and no secret."""
    if isinstance(value, str):
        return without_secrets(value.encode("utf-8", "replace").decode())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _clean(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_clean(item) for item in value]
    return value if value is None or isinstance(value, (bool, int)) else str(value)
