"""The head of a gateway's recordings: a signed text that says how far they reach, and when.

The chain of recordings shows what is missing before a recording, never what is missing after the newest one. Whoever
keeps a head elsewhere can show later that recordings up to it existed, and with which content.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.recording.files import file_number
from agent.recording.reading import open_recording
from agent.recording.signed_text import SignedText, SignedTextError, count, values_of, written
from agent.recording.signing import SignedStatement, Signer, prefix_sha256

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys
    from agent.recording.files import RecordingFile

Tell = Callable[[bytes], None]

HEAD_NAME = "head.json"
_PURPOSE = "fieldcal head, version 1"
_LINES = ["gateway", "epoch", "recording", "previous", "results", "content", "opening", "closed", "utc_ns"]
HEAD_S = 60.0  # s of event time between two heads of one recording

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Head:
    """What a head says.

    `statement`: of the newest recording, over its first `length` bytes. `opening`: `<bytes> <SHA-256>` of the beginning
    of this recording, the same in all of its heads. `closed`: whether the recording was finished.
    """

    statement: SignedStatement
    opening: str
    closed: bool
    utc_ns: int

    @property
    def text(self) -> str:
        """The bytes that the signature of a head is over."""
        more = {"opening": self.opening, "closed": "yes" if self.closed else "no", "utc_ns": str(self.utc_ns)}
        return written(_PURPOSE, self.statement.values | more)

    @property
    def place(self) -> tuple[int, int]:
        """How far the recordings reach: number of the recording, and bytes of it."""
        return self.statement.file_sequence, self.statement.length

    @staticmethod
    def of(signed: SignedText) -> Head:
        """What a signed text says; its signature is not checked. Raises SignedTextError where it is no head."""
        gateway, epoch, number, previous, results, content, opening, closed, utc_ns = values_of(
            signed.text, _PURPOSE, _LINES
        )
        length, _, sha256 = content.partition(" ")
        epoch, previous = ("" if value == "-" else value for value in (epoch, previous))
        statement = SignedStatement(gateway, epoch, count(number), previous, results, count(length), sha256)
        head = Head(statement, opening, closed == "yes", count(utc_ns))
        if head.text != signed.text:
            raise SignedTextError("its lines are not as this program writes them")
        return head


def head_beside(path: Path, gateway: str, keys: KnownKeys) -> Head | None:
    """The head in the directory of a recording that names it, signed by one of the gateway's keys; None without one."""
    try:
        signed = SignedText.read(path.with_name(HEAD_NAME).read_bytes())
        head = Head.of(signed)
    except (OSError, SignedTextError):
        return None
    named = (head.statement.gateway, head.place[0]) == (gateway, file_number(path.name))
    return head if named and not signed.fault_by(keys, gateway) else None


def begins_as_signed(path: Path, head: Head) -> bool:
    """Whether the bytes of a recording up to its head are those that were signed. Raises OSError."""
    with open_recording(path) as file:
        return prefix_sha256(file, head.statement.length).hex() == head.statement.sha256


class HeadKeeper:
    """Signs the head of a recording that is written, keeps it beside the recordings, and passes it on to `tell`.

    Call it only for bytes that are on the disk: a head must never reach further than a recording after a power cut.
    """

    def __init__(self, directory: Path, signer: Signer, tell: Tell) -> None:
        self._path = directory / HEAD_NAME
        self._signer = signer
        self._tell = tell
        self._opening = ""
        self._next_ns = 0

    def begin(self, file: RecordingFile, now_ns: int, utc_ns: int) -> None:
        """The first event of a recording is on the disk. `now_ns`: event time, CLOCK_MONOTONIC."""
        statement = file.statement()
        self._opening = f"{statement.length} {statement.sha256}"
        self._sign(statement, now_ns, utc_ns, closed=False)

    def go_on(self, file: RecordingFile, now_ns: int, utc_ns: int) -> None:
        """All of a recording so far is on the disk. Signs a head when the last one is HEAD_S old."""
        if now_ns >= self._next_ns:
            self._sign(file.statement(), now_ns, utc_ns, closed=False)

    def end(self, file: RecordingFile, now_ns: int, utc_ns: int) -> None:
        """The recording is finished."""
        self._sign(file.statement(), now_ns, utc_ns, closed=True)

    def _sign(self, statement: SignedStatement, now_ns: int, utc_ns: int, *, closed: bool) -> None:
        self._next_ns = now_ns + int(HEAD_S * 1e9)
        signed = self._signer.sign(Head(statement, self._opening, closed, utc_ns).text).json
        self._tell(signed)
        try:
            new = self._path.with_name(HEAD_NAME + ".new")
            with open(new, "wb") as file:
                file.write(signed)
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._path)
        except OSError as error:  # the disk may be full; the head is published nevertheless
            _log.warning(
                "%s cannot be written (%s): a crash now would leave a recording that cannot be signed later",
                self._path, error.strerror,
            )  # fmt: skip
