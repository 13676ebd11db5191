"""The heads that a witness keeps of other machines' recordings: one file a gateway, append-only, countersigned.

A line of a file is a text that the witness signed: its number, the SHA-256 of the line before it, the time of arrival
by the witness's clock, and the head as it was received. So no line can be changed or removed without the witness's key.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from agent.config.key_file import KeyFileError
from agent.recording.head import Head
from agent.recording.signed_text import LARGEST, SignedText, SignedTextError, count, values_of, written
from agent.recording.signing import Signer

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    from agent.config.known_keys import KnownKeys

KEY_NAME, PUBLIC_NAME, SUFFIX = "witness.key", "witness.pub", ".heads"
KEEP_NS = 600_000_000_000  # between two heads of one recording that are kept, besides its first and its last
GATEWAYS_MAX = 10_000  # without a list of keys, strangers could make files for ever
_PURPOSE = "fieldcal witness, version 1"
_LINES = ["number", "previous", "received_utc_ns", "head"]
_LARGEST_LINE = 4 * LARGEST
_GATEWAY = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}/[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


class WitnessError(Exception):
    """A file of a witness was changed or cannot be read. The message names the file and the line."""


@dataclass(frozen=True, slots=True)
class Kept:
    """One kept head, and when it arrived (UTC of the witness)."""

    signed: SignedText
    head: Head
    received_utc_ns: int


@dataclass(slots=True)
class Known:
    """What the kept heads of a gateway say, so that a contradiction is seen."""

    openings: dict[int, str] = field(default_factory=dict)  # by number of the recording
    closed: dict[int, tuple[int, str]] = field(default_factory=dict)  # length and SHA-256 of finished recordings
    newest: Head | None = None

    def contradiction(self, head: Head) -> str:
        """What a signed head contradicts: a proof that its key signed two histories; "" where nothing."""
        statement = head.statement
        number, content = statement.file_sequence, (statement.length, statement.sha256)
        closed, before = self.closed.get(number), self.closed.get(number - 1)
        newest = self.newest
        if self.openings.get(number, head.opening) != head.opening:
            return f"two recordings {number} with different beginnings were signed"
        if closed is not None and (content[0] > closed[0] or (head.closed and content != closed)):
            return f"two recordings {number} with different ends were signed"
        if before is not None and statement.previous_sha256 not in ("", before[1]):
            return f"recording {number} names another recording {number - 1} than the one that was signed"
        if newest is not None and newest.place == head.place and newest.statement != statement:
            return f"two recordings {number} with different content were signed"
        return ""

    def add(self, head: Head) -> None:
        """Take a signed head."""
        number = head.statement.file_sequence
        self.openings.setdefault(number, head.opening)
        if head.closed:
            self.closed.setdefault(number, (head.statement.length, head.statement.sha256))
        if self.newest is None or head.place > self.newest.place:
            self.newest = head


class HeadFile:
    """The kept heads of one gateway. Reading checks every line. Raises WitnessError, OSError."""

    def __init__(self, path: Path, key: Ed25519PublicKey, *, repair: bool = False) -> None:
        self._path = path
        self.known = Known()
        self.lines = 0
        self.contradictions: list[str] = []
        self.public_key = ""  # of the first head: the gateway's
        self.newest_of_each: dict[int, tuple[int, Kept]] = {}  # (line, head) by number of the recording
        self._previous = "-"
        self._kept_ns = 0  # time of the newest head's signature
        if path.exists():
            for kept in self._read(key, repair=repair):
                self._take(kept)

    def wants(self, head: Head) -> bool:
        """Whether a head is worth a line: first or last of its recording, later by KEEP_NS, or a new proof."""
        if contradiction := self.known.contradiction(head):
            return contradiction not in self.contradictions
        newest = self.known.newest
        if newest is None or head.place > newest.place:
            new = newest is None or head.statement.file_sequence > newest.statement.file_sequence
            return new or head.closed or head.utc_ns >= self._kept_ns + KEEP_NS
        return False

    def append(self, signed: SignedText, head: Head, received_utc_ns: int, signer: Signer) -> None:
        """Keep a head, whose signature was checked."""
        values = {
            "number": str(self.lines + 1),
            "previous": self._previous,
            "received_utc_ns": str(received_utc_ns),
            "head": signed.json.decode(),
        }
        line = signer.sign(written(_PURPOSE, values)).json + b"\n"
        with open(self._path, "ab") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self._previous = hashlib.sha256(line).hexdigest()
        self._take(Kept(signed, head, received_utc_ns))

    def _take(self, kept: Kept) -> None:
        self.lines += 1
        self.public_key = self.public_key or kept.signed.public_key
        if fault := self.known.contradiction(kept.head):
            self.contradictions.append(fault)
        self.known.add(kept.head)
        self.newest_of_each[kept.head.statement.file_sequence] = self.lines, kept
        if self.known.newest is kept.head:
            self._kept_ns = kept.head.utc_ns

    def _read(self, key: Ed25519PublicKey, *, repair: bool) -> Iterator[Kept]:
        good = 0
        with open(self._path, "rb") as file:
            while line := file.readline(_LARGEST_LINE + 1):
                number = self.lines + 1
                if repair and not line.endswith(b"\n") and file.tell() == os.fstat(file.fileno()).st_size:
                    break  # a power cut within the last line
                yield self._kept(line, number, key)
                self._previous = hashlib.sha256(line).hexdigest()
                good += len(line)
        if repair:
            os.truncate(self._path, good)

    def _kept(self, line: bytes, number: int, key: Ed25519PublicKey) -> Kept:
        where = f"{self._path}: line {number}"
        try:
            entry = SignedText.read(line.removesuffix(b"\n"), _LARGEST_LINE)
            if fault := entry.fault(key):
                raise WitnessError(f"{where}: {fault}")
            said, previous, received, head = values_of(entry.text, _PURPOSE, _LINES)
            if (said, previous) != (str(number), self._previous):
                raise WitnessError(f"{where}: it does not follow the line before it: lines were removed or reordered")
            signed = SignedText.read(head.encode())
            return Kept(signed, Head.of(signed), count(received))
        except SignedTextError as error:
            raise WitnessError(f"{where}: {error}") from None


class Witness:
    """Keeps heads in a directory. `clock`: UTC in ns.

    `keys`: gives the list of known keys as it is now; without it, a gateway's first key counts.
    Raises OSError or WitnessError where the files of the directory cannot be read.
    """

    def __init__(
        self, directory: Path, signer: Signer, keys: Callable[[], KnownKeys] | None, clock: Callable[[], int]
    ) -> None:
        self._directory, self._signer, self._keys, self._clock = directory, signer, keys, clock
        self._files = {
            f"{path.parent.name}/{path.name.removesuffix(SUFFIX)}": HeadFile(path, signer.public_key, repair=True)
            for path in sorted(directory.glob(f"*/*{SUFFIX}"))
        }

    def take(self, gateway: str, data: bytes) -> tuple[bool, str]:
        """Take what was published as the head of a gateway (`<site>/<name>`).

        Returns (whether it was kept, what to say about it or ""). Raises OSError, nothing else for any bytes.
        """
        try:
            signed = SignedText.read(data)
            head = Head.of(signed)
        except SignedTextError as error:
            return False, f"{gateway!r:.130}: refused, not a head: {error}"
        if head.statement.gateway != gateway or not _GATEWAY.fullmatch(gateway):
            return False, f"{gateway!r:.130}: refused, a head of {head.statement.gateway!r:.130}"
        if fault := self._fault(gateway, signed):
            return False, f"{gateway}: refused, {fault}"
        known = self._files.get(gateway)
        if known is None:
            if len(self._files) >= GATEWAYS_MAX:
                return False, f"{gateway}: refused, heads of {GATEWAYS_MAX} gateways are kept already"
            known = self._new(gateway)
        if known.public_key not in ("", signed.public_key) and self._keys is None:
            return False, f"{gateway}: refused, signed with the key {signed.key_id}, not with the one seen first"
        return self._keep(gateway, known, signed, head)

    def _fault(self, gateway: str, signed: SignedText) -> str:
        """Why the signature of a head does not count; "" where it does."""
        if self._keys is None:
            return signed.fault()
        try:
            return signed.fault_by(self._keys(), gateway)
        except KeyFileError as error:  # nobody knows which keys are revoked
            return str(error)

    def _keep(self, gateway: str, file: HeadFile, signed: SignedText, head: Head) -> tuple[bool, str]:
        if not file.wants(head):
            return False, ""
        contradiction = file.known.contradiction(head)
        file.append(signed, head, self._clock(), self._signer)
        if contradiction:
            return True, f"{gateway}: PROOF of two histories: {contradiction}; line {file.lines} is the second of them"
        number, length = head.place
        return True, f"{gateway}: recording {number}, {length} bytes{', closed' if head.closed else ''}"

    def _new(self, gateway: str) -> HeadFile:
        path = self._directory / f"{gateway}{SUFFIX}"
        path.parent.mkdir(exist_ok=True)
        return self._files.setdefault(gateway, HeadFile(path, self._signer.public_key))
