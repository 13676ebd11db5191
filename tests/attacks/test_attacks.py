"""Some attacks of benchmarks/attacks, at one place each: the audit ends with the status that belongs to them."""

from __future__ import annotations

from benchmarks.attacks.__main__ import run

FORGED = (
    "recording renamed",
    "recordings of a number used again",
    "no file in the place of a recording",
    "statements of a number used again",
    "end removed, head forged",
    "samples edited",
    "samples hostile",
    "snapshot edited",
    "fieldcal.pruned edited",
    "attachment put in",
)
UNSIGNED = ("unsigned: S 3 % off, U x 100, any engine", "unsigned: engine named otherwise")


def test_no_attack_passes() -> None:
    for kind, outcome in run((*FORGED, *UNSIGNED), [1]).items():
        assert set(outcome.statuses) <= ({"4"} if kind in UNSIGNED else {"2", "3"}), kind
        assert not outcome.faults, kind
