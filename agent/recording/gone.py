"""What is known of recordings that are not there, to compare it with heads that name them.

A recording that retention deleted is known from later recordings, from the list of deleted recordings whose SHA-256
these name, and, until the next recording begins, from statements in the directory.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.recording.chain import ChainLink
from agent.recording.deleted_list import listed
from agent.recording.files import misnamed
from agent.recording.head import Head
from agent.recording.pruned_ranges import Deleted, first_outside
from agent.recording.set_aside import statements

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

NOT_GIVEN = "that recordings which heads name were as these say: they are not given"
OLDER = "that deleted recordings which heads name were those: their SHA-256 is not in the list of deleted recordings"
OPEN = "that deleted recordings began with the bytes which heads name: these heads were signed before they were closed"


@dataclass(frozen=True, slots=True)
class Gone:
    """What the links and the directory say of recordings that are not there.

    `deleted`: what recordings say was deleted. `statements`: those that count. `listed`: what the list of deleted
    recordings says of those that heads name. `whole`: the recordings of a directory were given. `faults`: a list that
    is not the one that was signed, a second file of one number. `unproven`: statements that prove nothing, files that
    are no recordings.
    """

    links: Sequence[ChainLink]
    deleted: Sequence[Deleted] = ()
    statements: tuple[Deleted, ...] = ()
    listed: tuple[Deleted, ...] = ()
    whole: bool = False
    faults: tuple[str, ...] = ()
    unproven: tuple[str, ...] = ()

    def _stated_alone(self, number: int) -> str:
        """Why a statement that a recording was deleted is not enough; "" where there is none."""
        if first_outside(self.statements, number, number) is not None:
            return ""
        only = f"recording {number}, which this head names, is not there: only a statement says that it was deleted"
        return f"{only}, no later recording; the next recording of the gateway will repeat that"

    def compare(self, head: Head) -> tuple[str, str]:
        """(why the recording that a head names and that is not there should be there or was another one, what cannot be
        shown of it); "" for none. Only later recordings count: a statement alone can come from a copy of the directory.
        """
        said, number = head.statement, head.statement.file_sequence
        entries = [entry for entry in self.deleted if entry.first - 1 <= number <= entry.last + 1]
        if first_outside(entries, number, number) is not None:
            return self._stated_alone(number), ("" if self.whole else NOT_GIVEN)
        epochs = {entry.epoch for entry in entries if entry.first <= number <= entry.last} - {""}
        if said.epoch and epochs and said.epoch not in epochs:
            return f"recording {number} of the epoch {said.epoch}, which this head names, is not there", ""
        named, unknown = (said.sha256, OLDER) if head.closed else (said.previous_sha256, OPEN)
        digests = self._digests_beside(entries, head)
        if named and digests - {"", named}:
            return f"the deleted recording {number} was not the one that this head names: its SHA-256 differs", ""
        return "", ("" if head.closed and named in digests else unknown)

    def _digests_beside(self, entries: Iterable[Deleted], head: Head) -> set[str]:
        """All SHA-256 that are said of the recording of a closed head, otherwise of the one before it."""
        said, number = head.statement, head.statement.file_sequence
        of_head = [entry for entry in self.listed if entry.first == number and entry.epoch == said.epoch]
        if head.closed:
            return self._digests(entries, number) | {entry.sha256 for entry in of_head}
        return self._digests(entries, number - 1) | {entry.previous_sha256 for entry in of_head}

    def _digests(self, entries: Iterable[Deleted], number: int) -> set[str]:
        """All SHA-256 that are said of a recording by its neighbours and by what is said of them."""
        there = {link.sha256 for link in self.links if link.file_sequence == number and not link.incomplete}
        named = {link.previous_sha256 for link in self.links if link.file_sequence == number + 1}
        ends = {entry.sha256 for entry in entries if entry.last == number}
        begins = {entry.previous_sha256 for entry in entries if entry.first == number + 1}
        return (there | named | ends | begins) - {""}


def find_gone(directory: Path | None, links: Sequence[ChainLink], heads: Iterable[int], keys: KnownKeys | None) -> Gone:
    """Read what a data directory says of recordings that are not there; nothing without a `directory`. Raises OSError.

    `heads`: numbers of the recordings that heads name. With `keys` statements must be signed by one of the gateway's,
    and those of version 1 do not count: they do not say which recording is meant.
    """
    deleted = sorted({entry for link in links for entry in link.deleted})
    if directory is None:
        return Gone(links, deleted)
    gateway = next((link.gateway for link in links if link.gateway), "")
    there = {link.file_sequence for link in links}
    found = statements(directory, gateway, keys, deleted)
    newest = max((link for link in links if link.listed), key=lambda link: link.file_sequence, default=None)
    entries, fault = listed(directory, newest.listed if newest is not None else "", set(heads) - there)
    old = [
        f"that retention deleted recording {one.last}: a statement of version 1 says so, which does not say its SHA-256"
        for one in found.of_version_1
    ]
    doubles, others = _misnamed(directory, {link.number for link in links})
    return Gone(
        links,
        deleted,
        statements=(*found.deleted, *(found.of_version_1 if keys is None else ())),
        listed=tuple(entries),
        whole=True,
        faults=(*doubles, *filter(None, [fault])),
        unproven=(*old, *found.faults, *others),
    )


def _misnamed(directory: Path, numbers: Container[int]) -> tuple[list[str], list[str]]:
    """(faults of files that claim a number which is there, sentences about other files that were not looked at)."""
    doubles, others = list[str](), list[str]()
    for number, path in misnamed(directory):
        if number and number in numbers:
            doubles.append(f"{path}: this is not the name of a recording, and recording {number} is there already")
        else:
            others.append(f"what {path} holds: it was not looked at, because this is not the name of a recording")
    return doubles, others
