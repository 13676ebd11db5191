"""Recordings of which some are not given: what their epochs say about whether one follows the other."""

from __future__ import annotations

from agent.recording.chain import ChainLink, chain_faults


def link(number: int, epoch: str) -> ChainLink:
    return ChainLink(f"{number}.mcap", "site/gateway", epoch, number, f"{number:064d}", False, "", "", None)


def test_beyond_a_gap_a_recording_of_another_epoch_is_told() -> None:
    ((index, said),) = chain_faults([link(1, "a"), link(3, "b")], whole=False)
    assert index == 1
    assert said == "it is of another epoch than 1.mcap, and nothing given here shows that it follows"


def test_beyond_a_gap_one_epoch_and_files_of_older_versions_are_no_fault() -> None:
    for epochs in (("a", "a"), ("", "b"), ("a", "")):
        assert list(chain_faults([link(1, epochs[0]), link(3, epochs[1])], whole=False)) == []
