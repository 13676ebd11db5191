"""The driver contract on `sound-card`, with a twin of the library."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, Drop
from hw.conformance.sensor import Rig, SensorContract
from hw.sensor import ConfigurationError, DeviceLost
from hw.sound_card import SoundCard, SoundCardOptions, read_plate
from hw.virtual.sound_card_twin import SoundCardTwin

# model, format 1, serial number, counts per m/s2 of both channels, calibrated 17 May 2021
NAME = "333D01 1012345" + "60540" + "30270" + "210517: USB Audio (hw:1,0)"


class SoundCardRig(Rig):
    rate_hz = 8000.0

    def __init__(self) -> None:
        self.saturated = range(0)
        self.twin = SoundCardTwin(NAME, self.counts, lambda: self.due(self.t_s))
        self.sensor = self.build()

    def build(self, **changes: object) -> SoundCard:
        options = SoundCardOptions.model_validate(changes)
        return SoundCard("sensor", options, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> SoundCard:
        return self.build(device="no such card")

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n, dtype=np.int32)
        return np.column_stack([np.where(np.isin(k, self.saturated), 2**23 - 1, k - 500_000), -k])

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        numbers = indications.astype(np.int64)[:, 0] + 500_000
        full = numbers == 2**23 - 1 + 500_000
        numbers[full] = self.saturated.start
        return np.asarray(numbers)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.twin.next += 3
        self.twin.lost = 3

    def unplug(self) -> None:
        self.twin.plugged = False

    def replug(self) -> None:
        self.twin.plugged = True

    def close(self) -> None:
        self.sensor.close()


class TestSoundCard(SensorContract):
    @pytest.fixture
    def rig(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[SoundCardRig]:
        rig = SoundCardRig()
        monkeypatch.setitem(sys.modules, "sounddevice", rig.twin)  # type: ignore[arg-type]
        yield rig
        rig.close()

    def test_says_who_it_is_by_its_name(self, rig: SoundCardRig) -> None:
        info = rig.sensor.open()
        assert (info.kind, info.serial_number, info.axes) == ("333D01", "012345", 1)
        assert info.nominal_sensitivity == 60540
        assert info.range_mps2 == pytest.approx(2**23 / 60540)
        assert info.settings["calibrated"] == "210517"

    def test_an_overflow_throws_away_what_waited(self, rig: SoundCardRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(0.05)
        rig.lose()
        after = next(rig.blocks(0.1))
        assert after.flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert after.first_index == before.first_index + before.n
        (drop,) = rig.sensor.take_drops()
        assert (drop.unit, drop.reason) == ("samples", "input overflow")
        assert rig.number(after.indications)[0] == rig.number(before.indications)[-1] + 1 + 3 + drop.count
        assert isinstance(drop, Drop)

    def test_what_was_read_before_an_overflow_is_kept(self, rig: SoundCardRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        sleep, start_s = rig.sleep, rig.t_s

        def overflowing_underway(seconds: float) -> None:
            sleep(seconds)
            if rig.t_s > start_s + 0.2:
                rig.sleep = sleep  # type: ignore[method-assign]
                rig.lose()

        rig.sleep = overflowing_underway  # type: ignore[method-assign]
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert 0.15 * rig.rate_hz < block.n < 0.25 * rig.rate_hz
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1

    def test_a_rate_that_it_does_not_have(self, rig: SoundCardRig) -> None:
        with pytest.raises(DeviceLost, match="at 96000 Hz: Invalid sample rate"):
            rig.build(rate_hz=96000.0).open()


@pytest.mark.skipif("sounddevice" in sys.modules, reason="the library is installed")
def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    with pytest.raises(ConfigurationError, match=r"fieldcal extras --install sound"):
        SoundCard("sensor", SoundCardOptions.model_validate({})).open()


def test_plates() -> None:
    second = read_plate(NAME, 2)
    assert second is not None
    assert second.counts_per_mps2 == 30270
    conditioner = read_plate("485B39 2654321" + "0123456" + "0123457" + "200102", 1)
    assert conditioner is not None
    assert (conditioner.model, conditioner.serial_number, conditioner.counts_per_mps2) == ("485B39", "654321", None)
    assert conditioner.calibrated == "200102"
    assert read_plate("HDA Intel PCH: ALC (hw:0,0)", 1) is None
