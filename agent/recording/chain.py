"""Do recordings follow one another? Each names the SHA-256 of the one before; a number that is missing must have been
deleted by retention, and a record must say so."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from agent.core.events import Pruned
from agent.recording.pruned_ranges import Ranges, first_outside


@dataclass(frozen=True, slots=True)
class Link:
    """A recording, as far as its neighbours must agree with it."""

    path: str
    gateway: str
    file_sequence: int
    sha256: str
    incomplete: bool
    repaired: bool
    previous_sha256: str


def chain_faults(
    links: Sequence[Link], pruned: Sequence[Pruned], deleted: Ranges, *, from_first: bool
) -> Iterator[tuple[int, str]]:
    """(index, what is wrong) for each recording that does not follow the one before.

    `pruned` are the events that say what retention deleted, `deleted` all numbers of which anything says so.
    Compared are neighbours of one gateway with rising numbers. `from_first`: before the first there must be nothing.
    """
    if from_first and links:
        yield from ((0, fault) for fault in _gap(0, links[0], pruned, deleted))
    for index, (before, after) in enumerate(pairwise(links), start=1):
        if before.gateway != after.gateway or after.file_sequence <= before.file_sequence:
            continue
        if before.file_sequence + 1 < after.file_sequence:
            yield from ((index, fault) for fault in _gap(before.file_sequence, after, pruned, deleted))
        elif not _follows(before, after):
            yield index, f"{before.path} is not the file that was there before this one: its SHA-256 differs"


def _follows(before: Link, after: Link) -> bool:
    # One that was closed only after the next had begun could not be named yet.
    unnamed = before.repaired and not after.previous_sha256
    return before.incomplete or unnamed or after.previous_sha256 == before.sha256


def missing_after(last: int, expected: int) -> str:
    """What to say where numbers up to `expected` were given, and `last` is the highest that is there."""
    return f"{_span(last + 1, expected)} missing at the end" if expected > last else ""


def _gap(before: int, after: Link, pruned: Sequence[Pruned], deleted: Ranges) -> Iterator[str]:
    """What is wrong with the numbers missing between one and the next recording."""
    unsaid = first_outside(deleted, before + 1, after.file_sequence - 1)
    if unsaid is not None:
        yield f"{_span(*unsaid)} missing before it, and nothing here says that retention deleted it"
    for event in pruned:
        neighbour = event.last_file + 1 == after.file_sequence
        if neighbour and after.previous_sha256 and event.last_sha256 != after.previous_sha256:
            yield f"the recording {event.last_file} that was deleted is not the one that was there before this one"


def _span(first: int, last: int) -> str:
    return f"recording {first} is" if first == last else f"recordings {first} to {last} are"
