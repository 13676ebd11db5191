"""Whether a device sends as many samples as the configuration states.

`fieldcal init` and `doctor` count them too. With a wrong rate no window fits, and nothing else says why.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.core.events import DeviceChange, Event
from hw.block import SampleBlock

COUNTED_S = 10.0  # of arrivals; what waited in a buffer at the opening is half a second at most
# Oscillators of chips are off by some per cent, and the first block by half a second. No window fits a larger factor.
AGREES = 1.25


@dataclass(slots=True)
class _Arrivals:
    """The number behind the last sample of the first block since the opening, and its arrival."""

    next_index: int
    t_monotonic_ns: int


class ArrivalRates:
    """Takes the events of a run, and tells once of each device that sends at another rate than its nominal one."""

    def __init__(self) -> None:
        self._begun: dict[str, _Arrivals] = {}
        self._done: set[str] = set()

    def messages(self, event: Event) -> list[str]:
        """What is to be said after this event."""
        if isinstance(event, DeviceChange):
            self._begun.pop(event.device, None)
        if not isinstance(event, SampleBlock) or event.device in self._done:
            return []
        next_index, at_ns = event.first_index + event.n, event.t_monotonic_ns
        first = self._begun.setdefault(event.device, _Arrivals(next_index, at_ns))
        passed_s = (at_ns - first.t_monotonic_ns) / 1e9
        if passed_s < COUNTED_S:
            return []
        self._done.add(event.device)
        rate_hz = (next_index - first.next_index) / passed_s
        if event.nominal_rate_hz / AGREES <= rate_hz <= event.nominal_rate_hz * AGREES:
            return []
        return [
            f"{event.device}: {rate_hz:.4g} samples a second arrive, {event.nominal_rate_hz:g} are stated: correct "
            "rate_hz in its options, or the rate that is set in the device"
        ]
