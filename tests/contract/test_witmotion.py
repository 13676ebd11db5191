"""The driver contract on the WitMotion's twin, and the faults that only this device has."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, Drop
from hw.conformance.serial import SerialContract, SerialRig
from hw.cutting import Cutter
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.virtual.witmotion_twin import WitMotionTwin
from hw.witmotion import WitMotion, WitStream

LAP = 30_000


class WitMotionRig(SerialRig):
    driver = WitMotion
    known = {}  # noqa: RUF012
    rate_hz = 200.0

    def __init__(self, link: Path) -> None:
        self.twin = WitMotionTwin(self.counts, self.due, self.rate_hz)
        super().__init__(link)

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n)
        return np.column_stack([k % LAP, -(k // LAP), np.where(np.isin(k, self.saturated), 32767, 0x5155)])

    def write(self, first: int, n: int) -> bytes:
        raise AssertionError(f"the twin writes samples {first} to {first + n}")

    def received(self, data: bytes) -> None:
        self.twin.received(data)

    def text_due(self, t_s: float) -> bytes:
        self.text = self.noise or self.twin.text_due(t_s)
        return self.text

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x - LAP * y
        assert ((z == 0x5155) | ((z == 32767) & np.isin(numbers, self.saturated))).all()
        return numbers

    def open(self) -> DeviceInfo:
        info = super().open()
        self.twin.next = self.due(self.t_s)
        return info

    def lose(self) -> None:
        self.twin.next += 3


class TestWitMotion(SerialContract):
    samples = min(SerialContract.samples, 100_000)  # two frames a sample; it shares code with serial-binary

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[WitMotionRig]:
        rig = WitMotionRig(tmp_path / "port")
        yield rig
        rig.close()

    def test_says_who_it_is_and_how_it_is_set(self, rig: WitMotionRig) -> None:
        info = rig.open()
        assert info.serial_number == "WT4200001234"
        # Protocol: 32768 counts are 16 g.
        assert info.nominal_sensitivity == pytest.approx(2048 / 9.80665, rel=1e-12)
        assert {name: info.settings[name] for name in ("RSW", "RRATE", "AXOFFSET", "BANDWIDTH")} == {
            "RSW": "0x0003",
            "RRATE": "0x000B",
            "AXOFFSET": "0x0000",
            "BANDWIDTH": "0x0002",
        }
        assert rig.twin.registers[0x05] == 0

    def test_setting_that_does_not_take(self, rig: WitMotionRig) -> None:
        class Stubborn(WitMotionTwin):
            def received(self, data: bytes) -> None:
                super().received(data)
                self.registers[0x05] = 12

        rig.twin = Stubborn(rig.counts, rig.due, rig.rate_hz)
        with pytest.raises(ConfigurationError, match="AXOFFSET is 0x000C, not 0x0000"):
            rig.sensor.open()

    @pytest.mark.parametrize(("noise", "said"), [(b"", "nothing"), (b"hello, world\n", "bytes without an answer")])
    def test_wrong_identity(self, rig: WitMotionRig, noise: bytes, said: str) -> None:
        rig.noise = noise
        rig.twin = WitMotionTwin(rig.counts, lambda _: 0, rig.rate_hz)
        rig.twin.received = lambda data: None  # type: ignore[method-assign]  # noqa: ARG005
        with pytest.raises(IdentityError, match=rf"no WitMotion at 115200 baud \(received: .*{said}"):
            rig.sensor.open()

    def test_missing_samples_are_counted_by_the_clock(self, rig: WitMotionRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.twin.next += 7
        rig.sleep(0.04)
        after = next(rig.blocks(0.1))
        assert after.flags == BlockFlags.GAP
        assert after.first_index == before.first_index + before.n + 7

    def test_an_acceleration_without_its_time_is_no_sample(self, rig: WitMotionRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        rig.port.inject(b"\x55\x51" + bytes(8) + b"\xa6")
        (block,) = rig.blocks(0.3)
        assert block.flags == BlockFlags.NONE
        assert (np.diff(rig.number(block.indications)) == 1).all()

    def test_power_lost_underway(self, rig: WitMotionRig) -> None:
        # After a restart the device has its saved offsets again: none of its samples may be used.
        rig.open()
        list(rig.blocks(11.0))
        rig.twin.power_cycle()
        rig.twin.registers[0x02] = 0x03
        with pytest.raises(DeviceLost, match=r"did it lose power\?"):
            rig.sensor.read_block()
        rig.open()
        assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART
        assert rig.twin.registers[0x05] == 0

    def test_garbage_between_frames_costs_no_sample(self, rig: WitMotionRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.port.inject(b"\x55\x51\x55")
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
        assert rig.sensor.take_drops() == [Drop(3, "bytes", "no frame")]

    def test_temperature(self, rig: WitMotionRig) -> None:
        rig.open()
        (block,) = rig.blocks(0.4)
        assert (block.temperature_raw, block.temperature_degc) == (2503, 25.03)


def test_a_time_is_that_of_the_acceleration_right_behind_it() -> None:
    def frame(kind: int, content: bytes) -> bytes:
        body = bytes([0x55, kind]) + content
        return body + bytes([sum(body) % 256])

    def sample(k: int) -> list[bytes]:
        """Time of day, 10 ms a sample, and acceleration."""
        return [
            frame(0x50, bytes([26, 1, 1, 9, 30, 15]) + (10 * k).to_bytes(2, "little")),
            frame(0x51, k.to_bytes(2, "little") * 3 + bytes(2)),
        ]

    frames = [part for k in range(8) for part in sample(k)]
    frames[7] = frames[7][:-1] + b"?"  # the acceleration of sample 3
    frames[8] = b"?" + frames[8][1:]  # and the time of sample 4
    stream = WitStream(Cutter("s", 100.0), 100.0)
    stream.feed(b"".join(frames), 1, 1)
    found = [(block.first_index, block.indications[:, 0].tolist()) for block in stream.blocks()]
    assert found == [(0, [0, 1, 2]), (5, [5, 6, 7])]
