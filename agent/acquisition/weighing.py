"""Whether the first indications of a device are gravity, by the sensitivity that the configuration states.

`fieldcal init` tells the same of a port. A sensitivity per g, or that of another range, is seen here in two seconds.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agent.config import Channel, Config
from agent.core.events import DeviceChange, Event
from agent.core.identity import nominal_of
from calib.model import Array, scale_of
from hw.block import SampleBlock

FIRST_S = 2.0  # of samples whose mean is taken; that of motion is small beside gravity
# Offsets of MEMS accelerometers are 75 mg an axis at most (data sheets), which changes the length by 13 % at most.
AGREES = 1.25
STILL_MPS2 = 1.0  # an AC-coupled reference, which does not feel gravity, has a smaller mean


@dataclass(slots=True)
class _SampleSums:
    """The samples of one device so far."""

    total: Array
    count: int = 0


class Weighing:
    """Takes the events of a run, and tells once of each device whose first mean is not gravity."""

    def __init__(self, config: Config) -> None:
        self._channels = config.channels
        self._sums: dict[str, _SampleSums] = {}
        self._nominal: dict[str, float | None] = {}

    def messages(self, event: Event) -> list[str]:
        """What is to be said after this event."""
        if isinstance(event, DeviceChange) and event.state == "open" and event.device not in self._nominal:
            info = json.loads(event.info_json)
            self._nominal[event.device] = nominal_of(info)
            if info["axes"] == 3:
                self._sums[event.device] = _SampleSums(np.zeros(3))
        if not isinstance(event, SampleBlock) or (held := self._sums.get(event.device)) is None:
            return []
        held.total += event.indications.sum(axis=0)
        held.count += event.n
        if held.count < FIRST_S * event.nominal_rate_hz:
            return []
        mean = self._sums.pop(event.device).total / held.count
        return [told for channel in self._channels for told in self._judgement(channel, event.device, mean)]

    def _judgement(self, channel: Channel, device: str, mean: Array) -> Iterator[str]:
        """What the mean (3,) of a device says of this channel."""
        g, length = channel.gravity_mps2, float(np.linalg.norm(mean))
        at_rest = (
            f"its first mean has the length {length:.5g}, which at rest is gravity: about {length / g:.4g} per m/s2"
        )
        known = channel.prior.sensitivity is not None or self._nominal[device] is not None
        if device == channel.sensor and channel.coupling == "dc" and known:
            stated = channel.prior.mean(self._nominal[device])
            felt = float(np.linalg.norm(mean - stated[9:])) / scale_of(stated)
            if not g / AGREES <= felt <= g * AGREES:
                yield (
                    f"{device}: {at_rest}; by prior it is {felt:.4g} m/s2: correct prior.sensitivity (or offset_mps2), "
                    "or its range and unit in the options"
                )
        for beside in channel.by_reference:
            certificate = beside.certificate
            if beside.reference != device or certificate.quantity != "acceleration" or certificate.corner_hz:
                continue
            felt = length / certificate.sensitivity
            if felt > STILL_MPS2 and not g / AGREES <= felt <= g * AGREES:
                yield (
                    f"{device}: {at_rest}; by its certificate it is {felt:.4g} m/s2: correct certificate.sensitivity, "
                    "or its range and unit in the options"
                )
