"""Check that recordings follow one another without a gap.

Each recording holds the SHA-256 of the recording before it. Where a file number is missing, a record must say that
retention deleted that file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from agent.core.events import Pruned
from agent.recording.pruned_ranges import Ranges, first_outside


@dataclass(frozen=True, slots=True)
class Link:
    """The properties of one recording that must agree with the recording before it and the one after it."""

    path: str
    gateway: str
    file_sequence: int
    sha256: str
    incomplete: bool
    repaired: bool
    previous_sha256: str
    previous_results: str  # the chain of results at its beginning; "" in a file of an older version
    signed_results: str | None  # the chain at its end, as its signature says; None without such a signature


def chain_faults(
    links: Sequence[Link], pruned: Sequence[Pruned], deleted: Ranges, *, from_first: bool
) -> Iterator[tuple[int, str]]:
    """Yield (index in `links`, what is wrong) for each recording that does not follow the one before it.

    `pruned`: the Pruned events of these recordings. `deleted`: all file numbers that events or metadata name as deleted
    by retention. Only neighbours of the same gateway with rising numbers are compared. `from_first`: the recordings are
    those of a directory: of one gateway, and all from number 1 must be there or be named as deleted.
    """
    if from_first and links:
        yield from ((0, fault) for fault in _gap(0, links[0], pruned, deleted))
        yield from _foreign(links)
    for index, (before, after) in enumerate(pairwise(links), start=1):
        if before.gateway != after.gateway or after.file_sequence <= before.file_sequence:
            continue
        if before.file_sequence + 1 < after.file_sequence:
            yield from ((index, fault) for fault in _gap(before.file_sequence, after, pruned, deleted))
        elif not _follows(before, after):
            yield index, f"{before.path} is not the file that this one names as the one before it: its SHA-256 differs"
        elif before.signed_results is not None and after.previous_results not in ("", before.signed_results):
            yield index, f"its chain of results does not begin where the one of {before.path} ends"


def _foreign(links: Sequence[Link]) -> Iterator[tuple[int, str]]:
    known = [link for link in links if link.gateway]  # a file that cannot be read names none
    for index, link in enumerate(links):
        if link.gateway and link.gateway != known[0].gateway:
            whose = f"a recording of the gateway {link.gateway}, but {known[0].path} is one of {known[0].gateway}"
            yield index, f"{whose}; a directory holds the recordings of one gateway"


def _follows(before: Link, after: Link) -> bool:
    # A file that was repaired after the next one had begun had no SHA-256 yet that the next one could name.
    unnamed = before.repaired and not after.previous_sha256
    return before.incomplete or unnamed or after.previous_sha256 == before.sha256


def missing_after(links: Sequence[Link], expected: int, deleted: Ranges) -> str:
    """The fault where file numbers up to `expected` were used and the highest ones are not there; "" where none is."""
    last = max((link.file_sequence for link in links), default=0)
    missing = first_outside(deleted, last + 1, expected)
    return f"{span(missing[0], expected)} missing at the end" if missing is not None else ""


def _gap(before: int, after: Link, pruned: Sequence[Pruned], deleted: Ranges) -> Iterator[str]:
    """Yield the faults of the file numbers that are missing between number `before` and the recording `after`."""
    unsaid = first_outside(deleted, before + 1, after.file_sequence - 1)
    if unsaid is not None:
        yield f"{span(*unsaid)} missing before it, and no recording given here says that retention deleted it"
    for event in pruned:
        neighbour = event.last_file + 1 == after.file_sequence
        if neighbour and after.previous_sha256 and event.last_sha256 != after.previous_sha256:
            yield f"the SHA-256 of the deleted recording {event.last_file} is not the one that this recording names"


def span(first: int, last: int) -> str:
    """`recording 3 is` or `recordings 3 to 5 are`, for a sentence."""
    return f"recording {first} is" if first == last else f"recordings {first} to {last} are"
