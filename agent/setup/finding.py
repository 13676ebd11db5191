"""What a check of a gateway found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "advice", "fault"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. `fault`: the gateway does not work, or soon will not; `advice`: it works, with a disadvantage.

    `says` is what was found; `remedy` what the reader can do, "" where nothing is to be done.
    """

    check: str
    verdict: Verdict
    says: str
    remedy: str = ""
