"""Check that recordings follow one another without a gap.

Each recording holds the SHA-256 of the recording before it. Where a file number is missing, a record must say that
retention deleted that file. All that recordings and statements say about the SHA-256 of one recording must agree.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from agent.recording.files import file_number
from agent.recording.pruned_ranges import Deleted, first_outside, merged


@dataclass(frozen=True, slots=True)
class ChainLink:
    """The properties of one recording that must agree with the recording before it and the one after it."""

    path: str
    gateway: str
    epoch: str  # of the store; "" where there was none
    file_sequence: int
    sha256: str
    incomplete: bool
    previous_sha256: str
    previous_results: str  # the chain of results at its beginning; "" in a file of an older version
    signed_results: str | None  # the chain at its end, as its signature says; None without such a signature
    deleted: tuple[Deleted, ...] = ()  # what its metadata and its events Pruned say that retention deleted
    listed: str = ""  # bytes and SHA-256 of the list of deleted recordings; "" in a file of an older version

    @property
    def number(self) -> int:
        """The number in the file; that of the name where the file cannot be read; 0 where neither names one."""
        return self.file_sequence or file_number(Path(self.path).name) or 0


def chain_faults(
    links: Sequence[ChainLink], statements: Sequence[Deleted] = (), *, whole: bool
) -> Iterator[tuple[int, str]]:
    """Yield (index in `links`, what is wrong) for each recording that does not follow the one before it.

    The links may have any order. `statements`: what statements beside the recordings say was deleted. `whole`: the
    recordings are those of a directory: all from number 1 must be there, or be said to be deleted. Otherwise `unproven`
    names the gaps.
    """
    yield from _foreign(links, whole=whole)
    yield from _misnamed(links) if whole else ()
    order = _in_order(links)
    if not order:
        return
    yield from _gaps(order, _union([*_entries(links), *statements]), whole=whole)
    yield from _results(order)
    said = _RecordedStatements(order, statements)
    yield from said.contradictions()
    yield from said.strangers()
    for index, link in order:
        for entry in link.deleted:
            if entry.last >= link.number:
                yield index, f"it says that recording {entry.last} was deleted, which does not come before it"


def unproven(links: Sequence[ChainLink], statements: Sequence[Deleted] = (), *, whole: bool) -> Iterator[str]:
    """Yield what the links cannot show about the order of recordings, a sentence each, for the list `not proven`."""
    order, entries = _in_order(links), _entries(links)
    by_recordings = _union(entries)
    for (_, before), (_, after) in pairwise(order):
        missing = first_outside(by_recordings, before.number + 1, after.number - 1)
        if missing is not None and not whole:
            yield f"that {after.path} follows {before.path}: {span(*missing)} not given"
        elif before.number + 1 == after.number and not after.previous_sha256:
            yield f"that {after.path} follows {before.path}, which was not closed yet when the other one began"
    if whole:
        yield from _deletions(order, by_recordings, statements)
        yield from _unnamed(entries, statements)


def missing_after(links: Sequence[ChainLink], expected: int) -> str:
    """The fault where file numbers up to `expected` were used and the highest ones are not there; "" where none is."""
    last = max((link.file_sequence for link in links), default=0)
    return f"{span(last + 1, expected)} missing at the end" if last < expected else ""


def span(first: int, last: int) -> str:
    """`recording 3 is` or `recordings 3 to 5 are`, for a sentence."""
    return f"recording {first} is" if first == last else f"recordings {first} to {last} are"


class _RecordedStatements:
    """All that is said of recordings: the SHA-256 of recording k, by its number, and the epoch before and after k."""

    def __init__(self, order: Sequence[tuple[int, ChainLink]], statements: Sequence[Deleted]) -> None:
        self._order = order
        self._numbers = [link.number for _, link in order]
        self._sha256: dict[int, dict[tuple[str, str], int]] = {}  # (way, SHA-256): index of the link that says it
        self._ends: dict[int, dict[str, int]] = {}  # epochs of what ends with recording k, with the index of the link
        self._begins: dict[int, dict[str, int]] = {}  # epochs of what begins after it
        self._entries: dict[Deleted, int] = {}
        for index, link in order:
            there = Deleted(link.number, link.number, link.epoch, link.previous_sha256, link.sha256)
            self._add(replace(there, sha256="") if link.incomplete else there, index, "is", "names")
            for entry in link.deleted:
                self._entries.setdefault(entry, index)
        for entry in statements:
            self._entries.setdefault(entry, self._index_after(entry.last))
        for entry, index in self._entries.items():
            self._add(entry, index, "ends", "begins")

    def contradictions(self) -> Iterator[tuple[int, str]]:
        """Where two things that are said of the SHA-256 of one recording differ."""
        for number, said in self._sha256.items():
            (way, sha256), *others = sorted(said, key=lambda one: ("is", "names", "ends", "begins").index(one[0]))
            for other_way, other in others:
                if other == sha256:
                    continue
                index = said[other_way, other]
                if (way, other_way) == ("is", "names"):
                    path = self._order[bisect_left(self._numbers, number)][1].path
                    yield index, f"{path} is not the file that this one names as the one before it: its SHA-256 differs"
                elif way == "names":
                    what = f"the SHA-256 of the deleted recording {number} is not the one that this recording names"
                    yield said[way, sha256], what
                else:
                    yield index, f"a deletion that it or a statement names gives recording {number} another SHA-256"

    def strangers(self) -> Iterator[tuple[int, str]]:
        """Where the epoch changes, and no SHA-256 shows that what has the other one follows."""
        for number in self._ends.keys() & self._begins.keys():
            ways = {way for way, _ in self._sha256.get(number, ())}
            joined = ways & {"is", "ends"} and ways & {"names", "begins"}
            if not joined and not self._ends[number].keys() & self._begins[number].keys():
                yield self._index_after(number), f"nothing shows that it follows recording {number}, of another epoch"
        for entry, index in self._entries.items():
            inside = slice(bisect_left(self._numbers, entry.first), bisect_right(self._numbers, entry.last))
            for _, link in self._order[inside]:
                if "" not in (entry.epoch, link.epoch) and entry.epoch != link.epoch:
                    yield index, f"it names a deleted recording {link.number} of another epoch than {link.path}"

    def _add(self, said: Deleted, index: int, end: str, begin: str) -> None:
        for number, way, sha256, epochs in (
            (said.last, end, said.sha256, self._ends),
            (said.first - 1, begin, said.previous_sha256, self._begins),
        ):
            if sha256:
                self._sha256.setdefault(number, {}).setdefault((way, sha256), index)
            if said.epoch:
                epochs.setdefault(number, {}).setdefault(said.epoch, index)

    def _index_after(self, number: int) -> int:
        """Index of the first link after a number; of the last one where there is none."""
        return self._order[min(bisect_right(self._numbers, number), len(self._order) - 1)][0]


def _in_order(links: Sequence[ChainLink]) -> list[tuple[int, ChainLink]]:
    """(index, link) of the recordings that have a number, by number."""
    return sorted(((i, link) for i, link in enumerate(links) if link.number), key=lambda pair: pair[1].number)


def _entries(links: Sequence[ChainLink]) -> list[Deleted]:
    return sorted({entry for link in links for entry in link.deleted})


def _union(entries: Sequence[Deleted]) -> tuple[Deleted, ...]:
    """The numbers in the entries, whatever else they say."""
    return merged(Deleted(entry.first, entry.last) for entry in entries)


def _gaps(
    order: Sequence[tuple[int, ChainLink]], deleted: Sequence[Deleted], *, whole: bool
) -> Iterator[tuple[int, str]]:
    before: ChainLink | None = None
    for index, link in order:
        last = before.number if before is not None else 0
        unsaid = first_outside(deleted, last + 1, link.number - 1)
        if before is not None and last == link.number and (whole or before.sha256 != link.sha256):
            yield index, f"it has the number {last}, and so has {before.path}"
        elif unsaid is not None and whole:
            yield (
                index,
                f"{span(*unsaid)} missing before it, and no recording given here says that retention deleted it",
            )
        elif (
            unsaid is not None
            and before is not None
            and "" not in (before.epoch, link.epoch)
            and (before.epoch != link.epoch)
        ):
            yield index, f"it is of another epoch than {before.path}, and nothing given here shows that it follows"
        before = link


def _results(order: Sequence[tuple[int, ChainLink]]) -> Iterator[tuple[int, str]]:
    for (_, before), (index, after) in pairwise(order):
        follows = before.number + 1 == after.number and after.previous_sha256 == before.sha256
        if follows and before.signed_results is not None and after.previous_results not in ("", before.signed_results):
            yield index, f"its chain of results does not begin where the one of {before.path} ends"


def _foreign(links: Sequence[ChainLink], *, whole: bool) -> Iterator[tuple[int, str]]:
    known = [link for link in links if link.gateway]  # a file that cannot be read names none
    remedy = "a directory holds the recordings of one gateway" if whole else "audit those of one gateway together"
    for index, link in enumerate(links):
        if link.gateway and link.gateway != known[0].gateway:
            whose = f"a recording of the gateway {link.gateway}, but {known[0].path} is one of {known[0].gateway}"
            yield index, f"{whose}; {remedy}"


def _misnamed(links: Sequence[ChainLink]) -> Iterator[tuple[int, str]]:
    for index, link in enumerate(links):
        if link.file_sequence and file_number(Path(link.path).name) != link.file_sequence:
            yield index, f"its name is not the one of recording {link.file_sequence}, which it holds"


def _deletions(
    order: Sequence[tuple[int, ChainLink]], by_recordings: Sequence[Deleted], statements: Sequence[Deleted]
) -> Iterator[str]:
    numbers = [0, *(link.number for _, link in order)]
    repeated, all_of_them = (_missing(numbers, each) for each in (by_recordings, _union([*by_recordings, *statements])))
    if all_of_them:
        said = f"as later recordings say of {repeated} and only statements in the directory of {all_of_them - repeated}"
        yield f"what {all_of_them} recordings held: retention deleted them, {said}"
    for entry in statements:
        if entry.last in numbers:
            yield f"that recording {entry.last} was deleted: a statement says so, but it is there"


def _unnamed(entries: Sequence[Deleted], statements: Sequence[Deleted]) -> Iterator[str]:
    ends = {entry.last for entry in entries if entry.sha256}
    unnamed = _union([one for one in (*entries, *statements) if not one.sha256 and one.last not in ends])
    if unnamed:
        which = ", ".join(
            f"{one.first} to {one.last}" if one.first < one.last else f"{one.first}" for one in unnamed[:5]
        )
        yield f"which recordings {which} were: an older version deleted them, and did not say their SHA-256"


def _missing(numbers: Sequence[int], entries: Sequence[Deleted]) -> int:
    """How many numbers up to the last of `numbers`, which rise, are in the entries, which do not overlap, only."""
    named = sum(max(0, min(entry.last, numbers[-1]) - entry.first + 1) for entry in entries)
    return named - sum(bisect_right(numbers, entry.last) - bisect_left(numbers, entry.first) for entry in entries)
