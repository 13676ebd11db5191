"""A remembering consumer beside an agent and a router that are killed; `make faults` does it with 60 kills."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import remembering
from tests.faults.invariants import Findings
from tests.faults.needs import require
from tests.faults.outcome import Outcome
from tests.faults.remembering import Given, judge

pytestmark = pytest.mark.faults
TRUTH = {("a", 1): True, ("a", 2): True, ("a", 3): True, ("b", 1): True}


def test_every_signed_result_comes_once_and_in_order(tmp_path: Path) -> None:
    require("gcc")
    outcome = remembering.killed(tmp_path, 3)
    assert outcome.good, outcome


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("a1 a2 a3 *b1", ""),
        ("a1 a2 *b1", ""),
        ("a1 a2 a2 a3 *b1", "came again"),
        ("a1 a3 a2 *b1", "came after 3"),
        ("a1 a3 *b1", "never came"),
        ("a1 a2 b1", "never came"),
        ("a1 a2 a3 *b1 c1", "in no store"),
    ],
)
def test_what_must_not_be_is_seen(given: str, words: str) -> None:

    outcome = Outcome("", "", Findings())
    told = [Given(0, 0.0, w[-2], int(w[-1]), confirmed=True, new_epoch="*" in w, signed=True) for w in given.split()]
    judge(outcome, TRUTH, told, [100.0])
    assert words in " ".join(outcome.bad)
    assert bool(outcome.bad) == bool(words)
