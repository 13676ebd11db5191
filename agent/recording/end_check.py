"""Checks recordings against heads: is a recording, or a part of one, missing at the end? And what cannot be shown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from agent.recording.chain import ChainLink, span
from agent.recording.gone import Gone
from agent.recording.head import Head
from agent.recording.reading import open_recording
from agent.recording.signed_text import SignedText, SignedTextError
from agent.recording.signing import prefix_sha256

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

NO_HEAD = (
    "that no recording is missing at the end: there is no head of these recordings; give one that was kept elsewhere "
    "(--head, --witness)"
)
BESIDE = (
    "that no recording is missing after that head: it lies beside the recordings, and whoever deletes recordings can "
    "put an older head there; give one that was kept elsewhere (--head, --witness)"
)
NO_KEY = "who made these recordings and heads: give the gateway's key (--public-key) or a list of keys (--keys)"


@dataclass(frozen=True, slots=True)
class GivenHead:
    """The bytes of a head. `source`: where they come from. `elsewhere`: they were not found beside the recordings."""

    source: str
    data: bytes
    elsewhere: bool

    @property
    def number(self) -> int:
        """The number of the recording that it names; 0 where it is no head."""
        try:
            return Head.of(SignedText.read(self.data)).statement.file_sequence
        except SignedTextError:
            return 0


class End(msgspec.Struct, kw_only=True):
    """How far recordings can be shown to be complete.

    `recording`, `length`, `result`: number, bytes and last result that the newest head names; 0 without a head.
    `age_s`: of this head, at the time of the check; null without one. `reasons`: what is wrong. `unproven`: what cannot
    be shown.
    """

    head: str = ""  # where the newest head comes from
    gateway: str = ""
    recording: int = 0
    length: int = 0
    result: int = 0
    utc_ns: int = 0
    age_s: float | None = None
    reasons: list[str] = []
    unproven: list[str] = []

    def describe(self) -> Iterator[str]:
        """The lines for a reader."""
        if self.age_s is not None:
            result = f", result {self.result}" if self.result else ""
            yield (
                f"{self.head}: the head of {self.gateway} names recording {self.recording}, its first {self.length} "
                f"bytes{result}; signed {when(self.utc_ns)}, {_age(self.age_s)}"
            )
        yield from (f"FAILED: {reason}" for reason in self.reasons)
        yield from (f"not proven: {what}" for what in self.unproven)


def check_end(
    heads: Sequence[GivenHead], links: Sequence[ChainLink], gone: Gone, keys: KnownKeys | None, now_ns: int
) -> End:
    """Compare recordings with all given heads. `gone`: what is known of deleted recordings. `now_ns`: UTC.

    With `keys` each head must be signed by a key of the gateway that it names. Raises OSError.
    """
    end = End(reasons=[], unproven=[])
    newest: tuple[Head, GivenHead] | None = None
    by_number = {link.file_sequence: link for link in links if link.gateway}
    gateway = next((link.gateway for link in links if link.gateway), "")
    undecided: dict[str, list[int]] = {}
    for given in heads:
        try:
            signed = SignedText.read(given.data)
            head = Head.of(signed)
        except SignedTextError as error:
            end.reasons.append(f"{given.source}: not a head: {error}")
            continue
        if wrong := _signature_fault(signed, keys, head):
            end.reasons.append(f"{given.source}: its signature is not by the given key: {wrong}")
            continue
        if gateway and head.statement.gateway != gateway:
            fault = f"it is a head of {head.statement.gateway!r:.130}, the recordings are of {gateway!r:.130}"
        else:
            fault = _fault(head, by_number, gone, undecided)
        if fault:
            end.reasons.append(f"{given.source}: {fault}")
        if newest is None or (head.place, given.elsewhere) > (newest[0].place, newest[1].elsewhere):
            newest = head, given
    if newest is not None:
        _name(end, *newest, now_ns)
    end.unproven += _unproven(end, heads, undecided)
    if keys is None:
        end.unproven.append(NO_KEY)
    return end


def _unproven(end: End, heads: Sequence[GivenHead], undecided: Mapping[str, Sequence[int]]) -> Iterator[str]:
    """What the heads do not show: `end` names the newest of those that are heads, `undecided` recordings by reason."""
    if end.age_s is None:
        yield NO_HEAD
    elif not any(given.elsewhere for given in heads):
        yield BESIDE
    else:
        yield f"whether more was recorded after {when(end.utc_ns)}"
    for what, numbers in undecided.items():
        yield f"{what} (recording {min(numbers)}{f' and {n} more' if (n := len(numbers) - 1) else ''})"


def _signature_fault(signed: SignedText, keys: KnownKeys | None, head: Head) -> str:
    return signed.fault() if keys is None else signed.fault_by(keys, head.statement.gateway)


def _name(end: End, head: Head, given: GivenHead, now_ns: int) -> None:
    statement = head.statement
    end.head, end.gateway, end.utc_ns = given.source, statement.gateway, head.utc_ns
    end.recording, end.length = head.place
    number = statement.results.partition(" ")[0]
    end.result = int(number) if number.isascii() and number.isdigit() else 0
    end.age_s = (now_ns - head.utc_ns) * 1e-9


def _fault(head: Head, by_number: Mapping[int, ChainLink], gone: Gone, undecided: dict[str, list[int]]) -> str:
    """Why recordings do not reach as far as a head, with the content that it names; "" where they do.

    `undecided` gets what cannot be shown of a recording that is not there.
    """
    number, length = head.place
    last = max(by_number, default=0)
    if number > last:
        missing = span(last + 1, number)
        return f"{missing} missing at the end: this head of {when(head.utc_ns)} names recording {number}"
    if number not in by_number:
        fault, what = gone.compare(head)
        if what:
            undecided.setdefault(what, []).append(number)
        return fault
    path = by_number[number].path
    with open_recording(Path(path)) as file:
        if file.seek(0, 2) < length:
            return f"{path} has {file.tell()} bytes, but this head of {when(head.utc_ns)} names {length}"
        if prefix_sha256(file, length).hex() != head.statement.sha256:
            return f"{path} is not the recording that this head names: its first {length} bytes are others"
    return ""


def when(utc_ns: int) -> str:
    """A time as text, for any number."""
    try:
        return f"{datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError, OSError):
        return f"{utc_ns} ns UTC"


def _age(age_s: float) -> str:
    if age_s < 0:
        return f"{-age_s:.0f} s ahead of this machine's clock"
    for unit, seconds in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if age_s >= 2 * seconds:
            return f"{age_s / seconds:.0f} {unit} ago"
    return f"{age_s:.0f} s ago"
