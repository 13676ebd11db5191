"""What retention has deleted, in a metadata record that every later recording repeats.

The event Pruned names a deleted recording only once, and the recording that holds the event is itself deleted later.
Consecutive deleted recordings take one entry, so that the record stays small over years.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from agent.core.events import Pruned

PRUNED_METADATA = "fieldcal.pruned"
LIST = "list"  # in it: bytes and SHA-256 of the list of deleted recordings; recordings of older versions lack it
_ENTRY = re.compile(r"(\d{1,18})-(\d{1,18})(?: ([0-9A-Za-z-]{1,32}) ([0-9a-f]{64}|-) ([0-9a-f]{64}|-))?")


@dataclass(frozen=True, slots=True, order=True)
class Deleted:
    """Deleted recordings with consecutive numbers, `first` to `last`, of one epoch.

    `previous_sha256`: of the file that the first of them named as the one before it. `sha256`: of the last of them.
    A text is "" where it is not known: entries of older versions have numbers only.
    """

    first: int
    last: int
    epoch: str = ""
    previous_sha256: str = ""
    sha256: str = ""

    @staticmethod
    def of(event: Pruned) -> Deleted:
        """What an event says."""
        return Deleted(event.first_file, event.last_file, event.epoch, event.previous_sha256, event.last_sha256)

    @property
    def text(self) -> str:
        """The entry in the metadata record and in the list of deleted recordings."""
        return f"{self.first}-{self.last} " + " ".join(
            part or "-" for part in (self.epoch, self.previous_sha256, self.sha256)
        )

    @staticmethod
    def of_text(text: str) -> Deleted | None:
        """The entry that a text is; None where it is none."""
        match = _ENTRY.fullmatch(text)
        if match is None or int(match[1]) > int(match[2]):
            return None
        return Deleted(
            int(match[1]), int(match[2]), *("" if part in (None, "-") else part for part in match.groups()[2:])
        )


def merged(entries: Iterable[Deleted]) -> tuple[Deleted, ...]:
    """The same recordings in the fewest entries, rising. Entries of two epochs stay apart."""
    result: list[Deleted] = []
    for entry in sorted(entries):
        before = result[-1] if result else None
        if before is None or entry.first > before.last + 1 or entry.epoch != before.epoch:
            result.append(entry)
        elif entry.last > before.last:
            result[-1] = replace(before, last=entry.last, sha256=entry.sha256)
    return tuple(result)


def to_metadata(entries: Iterable[Deleted], listed: str) -> dict[str, str]:
    """The content of the MCAP metadata record named PRUNED_METADATA. `listed`: bytes and SHA-256 of the list."""
    return {"recordings": ",".join(entry.text for entry in entries), LIST: listed}


def from_metadata(metadata: dict[str, str] | None) -> tuple[Deleted, ...]:
    """The entries in such a metadata record; empty for None. Text in it that is no entry is ignored."""
    entries = map(Deleted.of_text, (metadata or {}).get("recordings", "").split(","))
    return tuple(entry for entry in entries if entry is not None)


def first_outside(entries: Iterable[Deleted], first: int, last: int) -> tuple[int, int] | None:
    """The first run of numbers within `first` to `last` that is in none of the entries; None where all numbers are."""
    for entry in sorted(entries) if first <= last else ():
        if entry.first > first:
            last = min(last, entry.first - 1)
            break
        first = max(first, entry.last + 1)
    return (first, last) if first <= last else None
