"""Geophones of a Raspberry Shake as the reference: counts of velocity, by datagrams and the driver to S in force."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import SampleBlock
from hw.shake_udp import ShakeUdp, ShakeUdpOptions
from hw.virtual.shake_twin import ShakeTwin
from tests.unit.drawn_recording import Devices, Recording, in_force, statuses

EPOCH_NS = 1_790_000_000_000_000_000
COUNTS = 4e8  # per m/s; a count is then about 2.5 nm/s
CHANNELS = ("EHE", "EHN", "EHZ")


class Shaken(Recording):
    """A recording in a building whose reference sends datagrams, of which every `lost`-th does not arrive."""

    lost = 0

    def _blocks(self, device: str, values: NDArray[np.float64], rate_hz: float) -> list[SampleBlock]:
        return super()._blocks(device, values, rate_hz) if device == "s" else self._received(values, rate_hz)

    def _received(self, values: NDArray[np.float64], rate_hz: float) -> list[SampleBlock]:
        """What the driver returns of the counts of these velocities, while a simulated clock runs."""
        counts, now_s = np.rint(COUNTS * values).astype(np.int32), [0.0]
        twin = ShakeTwin(
            CHANNELS, lambda first, n: counts[first : first + n], lambda: min(int(now_s[0] * rate_hz), len(counts)),
            rate_hz, EPOCH_NS,
        )  # fmt: skip

        def sleep(seconds: float) -> None:
            now_s[0] += seconds
            number = twin.next // 25
            twin.plugged = not self.lost or number % self.lost != self.lost - 1
            twin.serve()

        options = ShakeUdpOptions.model_validate({"port": twin.port, "listen": "127.0.0.1", "channels": CHANNELS})
        sensor = ShakeUdp(
            "r", options, clock=lambda: (round(now_s[0] * 1e9), EPOCH_NS + round(now_s[0] * 1e9)), sleep=sleep
        )
        sensor.open()
        blocks = []
        while now_s[0] < self.duration_s:
            if (block := sensor.read_block()) is not None:
                blocks.append(replace(block, boot_id="boot"))
        sensor.close()
        twin.close()
        return blocks


@pytest.mark.one_case
@pytest.mark.parametrize("lost", [0, 40])
def test_a_sensor_beside_it_is_calibrated(lost: int) -> None:
    recording = Shaken(5, Devices(derivatives=1, reference_noise=1e-6), bench=False)
    recording.lost = lost
    certificate: dict[str, Any] = {"quantity": "velocity", "sensitivity": COUNTS}
    results = recording.through_agent(certificate=certificate)
    assert "VALID" in statuses(results)
    assert "HELD" not in statuses(results)
    found = in_force(results)
    over_u = recording.errors_over_u(found.sensitivity, found.covariance, found.determined)
    assert np.abs(over_u).max() < 3.0
    assert np.sqrt(np.diag(found.covariance))[[0, 4, 8]].max() < 0.005
