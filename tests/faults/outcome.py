"""The outcome of one kind of fault: a row of the table in docs/reliability.md."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.faults.invariants import Findings


@dataclass
class Outcome:
    """The outcome of one fault.

    `injected`: what was done, and how often. `also`: what else was measured. `bad`: requirements that failed.
    """

    line: str
    injected: str
    findings: Findings
    also: str = ""
    bad: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether no requirement failed."""
        return self.findings.zeros and not self.bad

    def require(self, holds: bool, words: str) -> None:
        """Add `words` to the failed requirements unless `holds`."""
        if not holds:
            self.bad.append(words)

    def __str__(self) -> str:
        return f"{self.line}: {self.injected}; {self.findings}; {self.also}; {self.bad}"


COLUMNS = (
    "fault",
    "injected",
    "calibrations accepted",
    "lost",
    "stores unreadable",
    "recordings",
    "not replaying to their last flush",
    "calibrations off the truth",
    "also",
    "day",
    "verdict",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}"


def row(outcome: Outcome, day: str) -> str:
    """The outcome as a row under HEAD."""
    f = outcome.findings
    verdict = "holds" if outcome.good else "FAILS: " + "; ".join([*outcome.bad, *f.words][:3])
    cells = [
        outcome.line,
        outcome.injected,
        f.calibrations,
        f.lost,
        f.unreadable,
        f.recordings,
        f.not_replaying,
        f.wrong,
    ]
    return "| " + " | ".join(str(cell) for cell in [*cells, outcome.also, day, verdict]) + " |"
