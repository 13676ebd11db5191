"""Links of recordings, in any order: gaps, two gateways, two epochs, and deletions that contradict each other."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import pytest

from agent.recording.chain import Link, chain_faults, missing_after, unproven
from agent.recording.files import file_number, misnamed, recordings
from agent.recording.pruned_ranges import Deleted, from_metadata, merged, to_metadata

OLD, NEW = "0" * 15 + "1", "0" * 15 + "2"  # epochs


def sha256(number: int, of: str = "a") -> str:
    """The SHA-256 of recording `number` of the directory `of`; recording 0 is none."""
    return f"{of}{number:063x}" if number else ""


def link(number: int, epoch: str = OLD, of: str = "a", deleted: tuple[Deleted, ...] = ()) -> Link:
    return Link(
        path=f"{of}/fieldcal-{number:06d}.mcap",
        gateway="site/gateway",
        epoch=epoch,
        file_sequence=number,
        sha256=sha256(number, of),
        incomplete=False,
        previous_sha256=sha256(number - 1, of),
        previous_results="",
        signed_results=None,
        deleted=deleted,
    )


def gone(first: int, last: int, epoch: str = OLD, of: str = "a") -> Deleted:
    return Deleted(first, last, epoch, sha256(first - 1, of), sha256(last, of))


def faults(*links: Link, statements: tuple[Deleted, ...] = (), whole: bool = True) -> list[str]:
    return [f"{links[index].path}: {fault}" for index, fault in chain_faults(links, statements, whole=whole)]


def test_recordings_in_any_order_are_compared_by_number() -> None:
    links = [link(n) for n in (1, 2, 3, 4)]
    wrong = [*links[:2], link(3, of="b"), links[3]]
    differs = "is not the file that this one names as the one before it: its SHA-256 differs"
    for order in permutations(range(4)):
        for whole in (True, False):
            assert faults(*(links[i] for i in order), whole=whole) == []
            assert set(faults(*(wrong[i] for i in order), whole=whole)) == {
                f"b/fieldcal-000003.mcap: a/fieldcal-000002.mcap {differs}",
                f"a/fieldcal-000004.mcap: b/fieldcal-000003.mcap {differs}",
            }


def test_a_gap_between_given_recordings_is_not_proven_and_in_a_directory_a_fault() -> None:
    links = [link(5), link(2)]
    assert faults(*links, whole=False) == []
    said = "that a/fieldcal-000005.mcap follows a/fieldcal-000002.mcap: recordings 3 to 4 are not given"
    assert list(unproven(links, whole=False)) == [said]
    assert [fault.split(",")[0] for fault in faults(*links)] == [
        "a/fieldcal-000002.mcap: recording 1 is missing before it",
        "a/fieldcal-000005.mcap: recordings 3 to 4 are missing before it",
    ]


@pytest.mark.parametrize("whole", [True, False])
def test_recordings_of_two_gateways_are_refused(whole: bool) -> None:
    [fault] = faults(link(1), replace(link(2), gateway="site/other"), whole=whole)
    assert "a recording of the gateway site/other, but a/fieldcal-000001.mcap is one of site/gateway" in fault


def test_another_epoch_needs_a_digest_that_shows_that_it_follows() -> None:
    """A store that was made anew has another epoch. The recordings go on: each names the SHA-256 of the one before."""
    remade = [link(1), link(2), link(3, NEW), link(4, NEW)]
    for whole in (True, False):
        assert faults(*remade, whole=whole) == []
    assert faults(link(3, NEW, deleted=(gone(1, 2),))) == []
    assert faults(link(2), link(4, NEW), whole=False) == [
        "a/fieldcal-000004.mcap: it is of another epoch than a/fieldcal-000002.mcap, and nothing given here shows that "
        "it follows"
    ]
    assert faults(link(2), link(4), whole=False) == []
    unnamed = replace(link(3, NEW), previous_sha256="")
    assert faults(link(1), link(2), unnamed) == [
        "a/fieldcal-000003.mcap: nothing shows that it follows recording 2, of another epoch"
    ]
    assert faults(link(1), link(2), replace(unnamed, epoch=OLD)) == []


@pytest.mark.parametrize("name", ["fieldcal-000002.mcap.active", "fieldcal-0000002.mcap"])
def test_two_recordings_with_one_number(name: str) -> None:
    double = replace(link(2), path=f"a/{name}")
    assert "it has the number 2, and so has" in "".join(faults(link(1), link(2), double))
    assert faults(link(1), link(2), link(2), whole=False) == [], "the same file given twice"
    other = replace(link(2), sha256=sha256(9))
    assert "it has the number 2, and so has" in "".join(faults(link(1), link(2), other, whole=False))


def test_a_name_must_be_the_one_of_the_number_inside() -> None:
    [fault] = faults(link(1), replace(link(2), path="a/fieldcal-000007.mcap"))
    assert fault == "a/fieldcal-000007.mcap: its name is not the one of recording 2, which it holds"
    assert faults(link(1), replace(link(2), path="a/copy.mcap"), whole=False) == []


def test_deletions_that_the_next_recordings_confirm() -> None:
    assert faults(link(7, deleted=(gone(1, 6),)), link(8, deleted=(gone(1, 6),))) == []
    pinned = [link(1), link(2), link(7, deleted=(gone(3, 6),))]
    assert faults(*pinned) == []
    assert list(unproven(pinned, whole=True)) == [
        "what 4 recordings held: retention deleted them, as later recordings say of 4 and only statements in the "
        "directory of 0"
    ]
    read_meanwhile = [link(3), link(4), link(7, deleted=(gone(1, 6),))]
    assert faults(*read_meanwhile) == [], "a reader had opened 3 and 4"
    old = [Deleted(1, 6)]
    assert faults(link(7, deleted=tuple(old))) == []
    assert list(unproven([link(7, deleted=tuple(old))], whole=True))[1] == (
        "which recordings 1 to 6 were: an older version deleted them, and did not say their SHA-256"
    )


WRONG = {
    "another directory": (
        [link(7)], tuple(gone(n, n, NEW, "b") for n in range(1, 7)), "deleted recording 6 is not the one",
    ),
    "one of another directory": (
        [link(7)],
        tuple(gone(n, n, of="b" if n == 4 else "a") for n in range(1, 7)),
        "gives recording 4 another SHA-256",
    ),
    "one is missing": ([link(7)], tuple(gone(n, n) for n in (1, 2, 4, 5, 6)), "recording 3 is missing before it"),
    "the newest of another directory": (
        [link(1), link(2), link(3), link(7, NEW, "b", (gone(1, 6, NEW, "b"),))], (), "another epoch than a/",
    ),
    "the same, of the same epoch": (
        [link(1), link(2), link(3), link(7, OLD, "b", (gone(3, 6, OLD, "b"),))],
        (),
        "gives recording 2 another SHA-256",
    ),
    "a gap between two directories": (
        [link(1), link(7, NEW, "b", (Deleted(2, 6, NEW, "", sha256(6, "b")),))], (), "of another epoch",
    ),
    "a statement and another file": ([link(1), link(2)], (gone(1, 1, of="b"),), "gives recording 1 another SHA-256"),
    "a deletion of what comes later": ([link(1, deleted=(gone(1, 2),))], (), "which does not come before it"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_deletions_that_something_contradicts(case: str) -> None:
    links, statements, words = WRONG[case]
    assert words in "\n".join(faults(*links, statements=statements))


def test_ten_years_of_deletions_take_one_entry() -> None:
    """87,600 recordings, an hour each. The store was made anew once, and one recording is pinned."""
    entries: tuple[Deleted, ...] = ()
    for number in [*range(1, 1000), *range(1001, 87601)]:
        entries = merged([*entries, gone(number, number, OLD if number <= 50000 else NEW)])
    assert entries == (gone(1, 999), gone(1001, 50000), gone(50001, 87600, NEW))
    metadata = to_metadata(entries, "1 2")
    assert from_metadata(metadata) == entries
    assert sum(map(len, metadata.values())) < 600
    assert from_metadata({"recordings": "1-6,9-9,x,7-3,2-2 a b"}) == (Deleted(1, 6), Deleted(9, 9))


def test_the_end_is_missing_whatever_is_said_of_it() -> None:
    assert missing_after([link(1)], 1) == ""
    assert missing_after([link(1, deleted=(gone(2, 3),))], 3) == "recordings 2 to 3 are missing at the end"


def test_names_are_exact(tmp_path: Path) -> None:
    good = ["fieldcal-000001.mcap", "fieldcal-000002.mcap.active", "fieldcal-1000000.mcap", "fieldcal-999999.mcap"]
    like = ["fieldcal-0000001.mcap", "fieldcal-01.mcap", "fieldcal-٠٠٠٠٠٣.mcap", "copy.mcap", "Fieldcal-000001.MCAP"]
    for name in [*good, *like, "fieldcal-000001.mcap.lock", "head.json"]:
        (tmp_path / name).touch()
    assert [number for number, _ in recordings(tmp_path)] == [1, 2, 999999, 1000000]
    assert sorted((path.name, number) for number, path in misnamed(tmp_path)) == sorted(
        zip(like, [1, 1, 3, 0, 0], strict=True)
    )
    assert file_number("fieldcal-0000001.mcap") is None
