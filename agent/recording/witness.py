"""The heads that a witness keeps of other machines' recordings: one file a gateway, append-only, countersigned.

A line of a file is a text that the witness signed: its number, the SHA-256 of the line before it, the time of arrival
by the witness's clock, and the head as it was received. So no line can be changed or removed without the witness's key.

Which heads are worth a line depends on the witness's clock alone, never on the time that a head states. Each gateway
has an allowance of its own, so that what one gateway sends costs no other gateway a line.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
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
DAY_NS = 86_400_000_000_000
# Of one gateway. With files of an hour it needs 192 lines a day, 0.2 MB.
AT_ONCE_BYTES, A_DAY_BYTES = 256 << 10, 512 << 10
PROOFS_MAX = 16  # of two histories, kept of one gateway besides its allowance; one is enough to condemn its key
# Without a list of keys strangers can invent gateways: 25 MiB at once and 50 MiB a day for all of them together.
GATEWAYS_MAX, LISTED_GATEWAYS_MAX = 100, 10_000
_PURPOSE = "fieldcal witness, version 1"
_LINES = ["number", "previous", "received_utc_ns", "head"]
_LARGEST_LINE = 4 * LARGEST
_GATEWAY = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}/[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


class WitnessError(Exception):
    """A file of a witness was changed or cannot be read. The message names the file and the line."""


@dataclass(frozen=True, slots=True)
class KeptHead:
    """One kept head, and when it arrived (UTC of the witness)."""

    signed: SignedText
    head: Head
    received_utc_ns: int


@dataclass(slots=True)
class KnownHeads:
    """What heads of a gateway say, so that a contradiction is seen.

    `newest`: the head that reaches furthest, by epoch: a data directory that was lost begins again at recording 1.
    """

    openings: dict[int, str] = field(default_factory=dict)  # by number of the recording
    closed: dict[int, tuple[int, str]] = field(default_factory=dict)  # length and SHA-256 of finished recordings
    newest: dict[str, Head] = field(default_factory=dict)

    def contradiction(self, head: Head) -> str:
        """What a signed head contradicts: a proof that its key signed two histories; "" where nothing."""
        statement = head.statement
        number, content = statement.file_sequence, (statement.length, statement.sha256)
        closed, before = self.closed.get(number), self.closed.get(number - 1)
        newest = self.newest.get(statement.epoch)
        if self.openings.get(number, head.opening) != head.opening:
            return f"two recordings {number} with different beginnings were signed"
        if closed is not None and (content[0] > closed[0] or (head.closed and content != closed)):
            return f"two recordings {number} with different ends were signed"
        if before is not None and statement.previous_sha256 not in ("", before[1]):
            return f"recording {number} names another recording {number - 1} than the one that was signed"
        if newest is not None and newest.place == head.place and newest.statement != statement:
            return f"two recordings {number} with different content were signed"
        return ""

    def reaches(self, head: Head) -> bool:
        """Whether these heads reach as far as this one already."""
        newest = self.newest.get(head.statement.epoch)
        return newest is not None and newest.place >= head.place

    def add(self, head: Head) -> None:
        """Take a signed head."""
        number = head.statement.file_sequence
        self.openings.setdefault(number, head.opening)
        if head.closed:
            self.closed.setdefault(number, (head.statement.length, head.statement.sha256))
        if not self.reaches(head):
            self.newest[head.statement.epoch] = head


@dataclass(slots=True)
class ByteAllowance:
    """Bytes that a gateway may still cost, by the witness's clock. A clock that is set back takes nothing away."""

    left_bytes: float = AT_ONCE_BYTES
    at_ns: int = 0

    def at(self, now_ns: int) -> float:
        """The bytes that are left at this time."""
        gained = max(0, now_ns - self.at_ns) * A_DAY_BYTES / DAY_NS
        self.left_bytes, self.at_ns = min(AT_ONCE_BYTES, self.left_bytes + gained), now_ns
        return self.left_bytes


class HeadFile:
    """The kept heads of one gateway. Reading checks every line. Raises WitnessError, OSError."""

    def __init__(self, path: Path, key: Ed25519PublicKey, *, repair: bool = False) -> None:
        self._path = path
        self._known = KnownHeads()  # of the kept heads
        self.lines = 0
        self.contradictions: list[str] = []
        self.public_key = ""  # of the first head: the gateway's
        self.newest_of_each: dict[int, tuple[int, KeptHead]] = {}  # (line, head) by number of the recording
        self.heard_ns = 0  # from the first kept head to the last one
        self._first_ns: int | None = None
        self._previous = "-"
        self._kept_ns: dict[str, int] = {}  # when the newest head of each epoch arrived
        self._unkept: KeptHead | None = None  # it reaches further than the kept ones
        self._allowance = ByteAllowance()
        if path.exists():
            for line, kept in self._read(key, repair=repair):
                self._take(line, kept)

    def worth(self, offered: KeptHead) -> list[KeptHead]:
        """The heads to keep now that this one, whose signature was checked, has arrived: most often none or itself.

        Two, where it contradicts a head that was not kept: only both together prove two histories.
        """
        head, unkept, now_ns = offered.head, self._unkept, offered.received_utc_ns
        lately = KnownHeads()
        if unkept is not None:
            lately.add(unkept.head)
        contradiction = self._known.contradiction(head)
        fault = contradiction or lately.contradiction(head)
        if self._is_news(fault):
            return [offered] if contradiction or unkept is None else [unkept, offered]
        if self._known.reaches(head) or lately.reaches(head):
            return []  # an older one, perhaps sent again by a stranger
        if self._due(head, now_ns) and self._allowance.at(now_ns) > 0:
            return [offered]
        if head.statement.epoch in self._kept_ns:
            self._unkept = offered
        return []

    def _is_news(self, contradiction: str) -> bool:
        """Whether a contradiction is one, is not kept yet, and is among the first."""
        few = len(self.contradictions) < PROOFS_MAX
        return few and contradiction != "" and contradiction not in self.contradictions

    def _due(self, head: Head, now_ns: int) -> bool:
        """Whether a head that reaches further is the first or last of its recording, or comes later by KEEP_NS."""
        newest = self._known.newest.get(head.statement.epoch)
        if newest is None or head.closed or head.statement.file_sequence > newest.statement.file_sequence:
            return True
        return not 0 <= now_ns - self._kept_ns[head.statement.epoch] < KEEP_NS

    def append(self, kept: KeptHead, signer: Signer) -> None:
        """Keep a head. Raises OSError; the file is then as it was before, unless the disk itself fails."""
        values = {
            "number": str(self.lines + 1),
            "previous": self._previous,
            "received_utc_ns": str(kept.received_utc_ns),
            "head": kept.signed.json.decode(),
        }
        line = signer.sign(written(_PURPOSE, values)).json + b"\n"
        with open(self._path, "ab", buffering=0) as file:
            end = file.tell()
            try:
                if file.write(line) < len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
                os.fsync(file.fileno())
            except OSError:
                file.truncate(end)
                raise
        self._take(line, kept)

    def remove(self) -> None:
        """Delete the file, and the directory of its site if that is then empty. Raises OSError."""
        self._path.unlink(missing_ok=True)
        with suppress(OSError):
            self._path.parent.rmdir()

    def _take(self, line: bytes, kept: KeptHead) -> None:
        epoch, head = kept.head.statement.epoch, kept.head
        self.lines += 1
        self._previous = hashlib.sha256(line).hexdigest()
        self.public_key = self.public_key or kept.signed.public_key
        if self._is_news(fault := self._known.contradiction(head)):
            self.contradictions.append(fault)
        self._known.add(head)
        self.newest_of_each[head.statement.file_sequence] = self.lines, kept
        if self._known.newest[epoch] is head:
            self._kept_ns[epoch] = kept.received_utc_ns
            self._unkept = None
        self._first_ns = kept.received_utc_ns if self._first_ns is None else self._first_ns
        self.heard_ns = max(self.heard_ns, kept.received_utc_ns - self._first_ns)
        self._allowance.at(kept.received_utc_ns)
        self._allowance.left_bytes -= len(line)

    def _read(self, key: Ed25519PublicKey, *, repair: bool) -> Iterator[tuple[bytes, KeptHead]]:
        good = 0
        with open(self._path, "rb") as file:
            while line := file.readline(_LARGEST_LINE + 1):
                number = self.lines + 1
                if repair and not line.endswith(b"\n") and file.tell() == os.fstat(file.fileno()).st_size:
                    break  # a power cut within the last line
                yield line, self._kept(line, number, key)
                good += len(line)
        if repair:
            os.truncate(self._path, good)

    def _kept(self, line: bytes, number: int, key: Ed25519PublicKey) -> KeptHead:
        where = f"{self._path}: line {number}"
        try:
            entry = SignedText.read(line.removesuffix(b"\n"), _LARGEST_LINE)
            if fault := entry.fault(key):
                raise WitnessError(f"{where}: {fault}")
            said, previous, received, head = values_of(entry.text, _PURPOSE, _LINES)
            if (said, previous) != (str(number), self._previous):
                raise WitnessError(f"{where}: it does not follow the line before it: lines were removed or reordered")
            signed = SignedText.read(head.encode())
            return KeptHead(signed, Head.of(signed), count(received))
        except SignedTextError as error:
            raise WitnessError(f"{where}: {error}") from None


class ChainWitness:
    """Keeps heads in a directory. `clock`: UTC in ns.

    `keys`: gives the list of known keys as it is now; without it, a gateway's first key counts, and GATEWAYS_MAX
    gateways have a place. Then a new gateway takes the place of the one that was heard for the shortest time, if that
    is less than a day: strangers that invent names keep no real gateway out, and never take the place of an old one.

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

        Returns (whether it was kept, what to say about it or ""). Raises OSError, nothing else for any bytes; on a full
        disk (ENOSPC, EDQUOT) what was kept before is as it was, and the next head may be kept again.
        """
        try:
            signed = SignedText.read(data)
            head = Head.of(signed)
        except SignedTextError as error:
            return False, f"{gateway!r:.130}: refused, not a head: {error}"
        if head.statement.gateway != gateway or not _GATEWAY.fullmatch(gateway):
            return False, f"{gateway!r:.130}: refused, a head of {head.statement.gateway!r:.130}"
        known = self._files.get(gateway)
        if known is not None and self._keys is None and known.public_key not in ("", signed.public_key):
            return False, f"{gateway}: refused, signed with the key {signed.key_id}, not with the one seen first"
        if fault := self._fault(gateway, signed):
            return False, f"{gateway}: refused, {fault}"
        if known is None:
            if fault := self._make_place(gateway):
                return False, f"{gateway}: refused, {fault}"
            known = self._new(gateway)
        try:
            return self._keep(gateway, known, KeptHead(signed, head, self._clock()))
        finally:
            if not known.lines:  # the disk is full
                self._remove(gateway)

    def _fault(self, gateway: str, signed: SignedText) -> str:
        """Why the signature of a head does not count; "" where it does."""
        if self._keys is None:
            return signed.fault()
        try:
            return signed.fault_by(self._keys(), gateway)
        except KeyFileError as error:  # nobody knows which keys are revoked
            return str(error)

    def _make_place(self, gateway: str) -> str:
        """Make a place for a new gateway; why it gets none, "" where it has one. Raises OSError."""
        site = self._directory / gateway.partition("/")[0]
        if site.exists() and not site.is_dir():
            return f"{site} is a file of this machine"
        most = GATEWAYS_MAX if self._keys is None else LISTED_GATEWAYS_MAX
        if len(self._files) < most:
            return ""
        least = min(self._files, key=lambda name: self._files[name].heard_ns)
        if self._keys is not None or self._files[least].heard_ns >= DAY_NS:
            return f"heads of {most} gateways are kept already; a list of keys says which ones count (--keys)"
        self._remove(least)
        return ""

    def _keep(self, gateway: str, file: HeadFile, offered: KeptHead) -> tuple[bool, str]:
        before = len(file.contradictions)
        worth = file.worth(offered)
        for kept in worth:
            file.append(kept, self._signer)
        if not worth:
            return False, ""
        if len(file.contradictions) > before:
            what = file.contradictions[-1]
            return True, f"{gateway}: PROOF of two histories: {what}; line {file.lines} is the second of them"
        number, length = offered.head.place
        return True, f"{gateway}: recording {number}, {length} bytes{', closed' if offered.head.closed else ''}"

    def _new(self, gateway: str) -> HeadFile:
        path = self._directory / f"{gateway}{SUFFIX}"
        path.parent.mkdir(exist_ok=True)
        return self._files.setdefault(gateway, HeadFile(path, self._signer.public_key))

    def _remove(self, gateway: str) -> None:
        self._files.pop(gateway).remove()
