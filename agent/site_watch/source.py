"""Where the days of a site come from: files, recordings, or what the monitor keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from agent.site_watch.day_sum import DaySum


class WatchError(Exception):
    """Nothing of what was given can be used. The message says why."""


@dataclass(slots=True)
class SiteSource:
    """A site. `sensors`: (gateway, sensor), `numbers`: how `sums` calls each; `bands`: third octaves n of 10^(n/10) Hz.

    `sums`: the days in order, anew at each call. `lines`: hourly results that were read; `left_out`: those that were
    not used, by reason; `first`: where each reason was met first.
    """

    sensors: Sequence[tuple[str, str]]
    numbers: Sequence[int]
    bands: Sequence[int]
    sums: Callable[[], Iterator[DaySum]]
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    first: dict[str, str] = field(default_factory=dict)

    @property
    def gateways(self) -> list[str]:
        """Names of the gateways, by number."""
        return sorted({gateway for gateway, _ in self.sensors})
