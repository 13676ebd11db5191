"""The driver contract on Epson's twins, frames of the data sheet, and the faults that only these devices have."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from hw import epson_frames as epson
from hw.block import BlockFlags, DeviceInfo
from hw.conformance.serial import SerialContract, SerialRig
from hw.cutting import Cutter
from hw.epson import Epson, EpsonOptions, EpsonStream
from hw.frames import CHECKSUMS
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.virtual.epson_twin import EpsonTwin

LAP = 30_000


class EpsonRig(SerialRig):
    driver = Epson
    known = {}  # noqa: RUF012
    rate_hz = 1000.0
    product = b"A352AD10"
    scale, highest = 2**24, 15 * 2**24

    def __init__(self, link: Path) -> None:
        self.twin = EpsonTwin(self.counts, self.due, product=self.product)
        super().__init__(link)

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n)
        z = np.where(np.isin(k, self.saturated), self.highest, 0x0D800D)
        return np.column_stack([k % LAP, -(k // LAP), z]).astype(np.int32)

    def write(self, first: int, n: int) -> bytes:
        raise AssertionError(f"the twin writes samples {first} to {first + n}")

    def received(self, data: bytes) -> None:
        self.twin.received(data)

    def text_due(self, t_s: float) -> bytes:
        self.text = self.noise or self.twin.text_due(t_s)
        return self.text

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = np.asarray(indications * self.scale, np.int64).T
        numbers = x - LAP * y
        assert ((z == 0x0D800D) | ((z == self.highest) & np.isin(numbers, self.saturated))).all()
        return numbers

    def open(self) -> DeviceInfo:
        info = super().open()
        self.twin.next = self.due(self.t_s)
        return info

    def lose(self) -> None:
        self.twin.next += 3


class VelocityRig(EpsonRig):
    known = {"unit": "m/s"}  # noqa: RUF012
    rate_hz = 3000.0
    product = b"A342VD10"
    scale, highest = 2**22, 2**23 - 1


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[EpsonRig]:
    rig = EpsonRig(tmp_path / "port")
    yield rig
    rig.close()


class TestAccelerometer(SerialContract):
    samples = min(SerialContract.samples, 100_000)  # it shares code with serial-binary, whose test reads more

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[EpsonRig]:
        rig = EpsonRig(tmp_path / "port")
        yield rig
        rig.close()


class TestVibrationSensor(SerialContract):
    samples = 70_000  # more than its counter of 16 bits has; that of an accelerometer rises by more than one a sample

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[VelocityRig]:
        rig = VelocityRig(tmp_path / "port")
        yield rig
        rig.close()


def test_an_accelerometer_says_who_it_is_and_how_it_is_set(rig: EpsonRig) -> None:
    rig.twin.registers[1][0x2C] = 7  # somebody's offset
    rig.twin.registers[1][0x46] = 0xFE  # values end at -2 g
    info = rig.open()
    assert (info.kind, info.serial_number, info.unit) == ("M-A352AD10", "W0000501", "g")
    assert info.nominal_sensitivity == pytest.approx(1 / 9.80665, rel=1e-12)
    assert info.range_mps2 == pytest.approx(15 * 9.80665, rel=1e-12)
    # Data sheet: 1000 Hz is code 2, 512 taps at 460 Hz code 10; 511 / 2 periods of 4 kHz are 63.875 ms (table 5.4)
    assert (info.settings["SMPL_CTRL"], info.settings["FILTER_CTRL"]) == ("0x0200", "0x000A")
    assert info.filters == ("delay delay_s=0.063875",)
    assert (info.settings["BURST_CTRL"], info.settings["UART_CTRL"]) == ("0xC703", "0x0001")
    assert (info.settings["OFFSET_XA_HIGH"], info.settings["XALARM"]) == ("0x0000", "0x0FF1")
    assert rig.twin.sampling
    rig.sensor.close()
    rig.port.serve()
    assert not rig.twin.sampling


def test_a_vibration_sensor_indicates_velocity(tmp_path: Path) -> None:
    rig = VelocityRig(tmp_path / "other")
    try:
        info = rig.open()
        assert (info.kind, info.unit, info.filters) == ("M-A342VD10", "m/s", ())
        assert (info.range_mps2, info.nominal_sensitivity) == (None, None)
        assert info.settings["SIG_CTRL"] == "0x0E00"
    finally:
        rig.close()


def test_a_sensor_that_sends_already_is_stopped_first(rig: EpsonRig) -> None:
    rig.open()
    list(rig.blocks(0.6))
    rig.sensor.close()
    rig.twin.received(bytes.fromhex("fe000d 83010d fe"))  # another program began it, and left half a command
    assert rig.twin.sampling
    rig.open()
    assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART
    assert rig.sensor.take_drops() == []


def test_the_other_kind_of_sensor_is_named(rig: EpsonRig) -> None:
    with pytest.raises(
        IdentityError, match=r"M-A352AD10 does not send m/s; correct unit, or connect an M-A342 or M-A542VR"
    ):
        rig.build(unit="m/s", rate_hz=3000).open()


@pytest.mark.parametrize(("noise", "said"), [(b"", "nothing"), (b"hello, world\n", "bytes without an answer")])
def test_no_sensor(rig: EpsonRig, noise: bytes, said: str) -> None:
    rig.noise = noise
    rig.twin.received = lambda data: None  # type: ignore[method-assign]  # noqa: ARG005
    with pytest.raises(IdentityError, match=rf"no Epson sensor at 460800 baud \(received: .*{said}"):
        rig.sensor.open()


def test_a_setting_that_does_not_take(rig: EpsonRig) -> None:
    class Stubborn(EpsonTwin):
        def received(self, data: bytes) -> None:
            super().received(data)
            self.registers[1][0x05] = 4

    rig.twin = Stubborn(rig.counts, rig.due)
    with pytest.raises(ConfigurationError, match="SMPL_CTRL is 0x0400, not 0x0200"):
        rig.sensor.open()


def test_errors_that_the_sensor_reports(rig: EpsonRig) -> None:
    rig.open()
    list(rig.blocks(0.6))
    rig.twin.error = True
    with pytest.raises(DeviceLost, match=r"the sensor reports an error \(flag EA\)"):
        list(rig.blocks(1.0))
    rig.twin.registers[0][0x04] = 0x20
    with pytest.raises(ConfigurationError, match=r"M-A352AD10 reports a hardware error \(DIAG_STAT 0x0020\)"):
        rig.open()


def test_a_power_loss_is_silence_and_the_settings_come_back(rig: EpsonRig) -> None:
    rig.open()
    list(rig.blocks(0.6))
    rig.twin.power_cycle()
    assert [rig.sensor.read_block() for _ in range(3)][-1] is None
    assert rig.open().settings["SMPL_CTRL"] == "0x0200"
    assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART


def test_missing_samples_are_counted(rig: EpsonRig) -> None:
    rig.open()
    *_, before = rig.blocks(0.6)
    rig.twin.next += 7
    rig.sleep(0.04)
    after = next(rig.blocks(0.1))
    assert after.flags == BlockFlags.GAP
    assert after.first_index == before.first_index + before.n + 7


def test_after_a_long_pause_nobody_can_count(rig: EpsonRig) -> None:
    """The counter wraps around in 16.4 s; after 20 s it would tell 3.6 s."""
    rig.open()
    list(rig.blocks(0.6))
    rig.sleep(20.0)
    blocks = list(rig.blocks(4.0))
    assert sum(bool(block.flags & BlockFlags.RESTART) for block in blocks) == 1
    assert not any(block.flags & BlockFlags.GAP for block in blocks)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate_hz": 250}, "250 Hz is not a rate of this device; use one of 1000, 500, 200, 100, 50"),
        ({"rate_hz": 1000, "baud_rate": 230400}, "240000 bit/s; baud_rate is only 230400"),
        ({"filter": "k512_fc210"}, "does not go with 200 Hz; use one of k128_fc36, k512_fc9, k512_fc16, k512_fc60"),
        ({"unit": "m/s"}, "velocities come at 3000 Hz"),
        ({"unit": "m/s", "rate_hz": 3000, "baud_rate": 230400}, "390000 bit/s; baud_rate is only 230400"),
    ],
)
def test_options_that_cannot_be(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        EpsonOptions.model_validate({"port": "p"} | changes)


def test_filters_that_the_data_sheet_allows() -> None:
    """Table 5.4, column by column."""
    table = {
        50: ["k512_fc9"],
        100: ["k512_fc9", "k512_fc16"],
        200: ["k128_fc36", "k512_fc9", "k512_fc16", "k512_fc60"],
        500: ["k64_fc83", "k128_fc36", "k128_fc110", "k512_fc9", "k512_fc16", "k512_fc60", "k512_fc210"],
        1000: list(epson.FILTER_CODES),
    }
    for rate_hz, names in table.items():
        assert (
            EpsonOptions.model_validate({"port": "p", "rate_hz": rate_hz, "baud_rate": 460800}).valid_filters == names
        )


# Worked by hand from the formats of the data sheet: 32-bit two's complement with 24 binary places; "0x0F000000" for
# +15 G or more, "0xF1000000" for -15 G or less (7.7). The mG of the README of py_esensorlib for the register dump of an
# M-A352 (0xFFFCE388, 0x00093A7A, 0x00FF0624): -203896, 604794 and 16713252 counts of 2^-24.
ACCELERATIONS = [
    ("00000000", 0.0),
    ("00000001", 5.9604644775390625e-08),
    ("ffffffff", -5.9604644775390625e-08),
    ("01000000", 1.0),
    ("ff000000", -1.0),
    ("00800000", 0.5),
    ("ff800000", -0.5),
    ("0f000000", 15.0),
    ("f1000000", -15.0),
    ("00ffffff", 1.0 - 2.0**-24),
    ("0effffff", 15.0 - 2.0**-24),
    ("f1000001", -15.0 + 2.0**-24),
    ("64000000", 100.0),  # the error code for a filter that does not go with the rate
    ("fffce388", -203896 / 16777216),
    ("00093a7a", 604794 / 16777216),
    ("00ff0624", 16713252 / 16777216),
]
# 24-bit two's complement with 22 binary places; the register dump of an M-A342 in the README of py_esensorlib has
# 0x0025, 0x001D and 0x00B4.
VELOCITIES = [
    ("000000", 0.0),
    ("000001", 2.384185791015625e-07),
    ("ffffff", -2.384185791015625e-07),
    ("400000", 1.0),
    ("c00000", -1.0),
    ("7fffff", 2.0 - 2.0**-22),
    ("800000", -2.0),
    ("000025", 37 / 4194304),
    ("00001d", 29 / 4194304),
    ("0000b4", 180 / 4194304),
]
# The data sheet: 2634 at 25 degC; the dump of an M-A352: 0x09A2 = 2466, 34.987 - 9.3505788.
TEMPERATURES = [("00000000", 34.987), ("00000a4a", 24.9993988), ("000009a2", 25.6364212), ("ffffffff", 34.9907918)]


@pytest.mark.parametrize(("data", "g"), ACCELERATIONS)
def test_accelerations(data: str, g: float) -> None:
    frame = bytes.fromhex("80 8e00 00000a4a 00000000") + bytes.fromhex(data) * 2 + bytes.fromhex("0014 0000 0d")
    assert epson.indications(np.frombuffer(frame, np.uint8)[None], epson.ACCELERATION).tolist() == [[0.0, g, g]]


@pytest.mark.parametrize(("data", "mps"), VELOCITIES)
def test_velocities(data: str, mps: float) -> None:
    frame = bytes.fromhex("80 000000") + bytes.fromhex(data) * 2 + bytes.fromhex("0001 0d")
    assert epson.indications(np.frombuffer(frame, np.uint8)[None], epson.VELOCITY).tolist() == [[0.0, mps, mps]]


@pytest.mark.parametrize(("data", "degc"), TEMPERATURES)
def test_temperatures(data: str, degc: float) -> None:
    frame = bytes.fromhex("80 8e00" + data) + bytes(17)
    raw, found = epson.temperature(np.frombuffer(frame, np.uint8))
    assert raw == int.from_bytes(bytes.fromhex(data), "big", signed=True)
    assert found == pytest.approx(degc, abs=1e-7)


def test_the_checksum_of_the_data_sheet() -> None:
    # Section 5.10: the sum of these words is 611B4. One word more than a frame of an accelerometer without tilt has.
    words = bytes.fromhex("FE01C45540000052 33C000437BC8004A 2608FD733AA0FF75 4C301F538FD00600 0014")
    assert CHECKSUMS["sum16"][1](words, "big") == 0x11B4


def test_text_of_registers() -> None:
    # The dump of an M-A352 in the README of py_esensorlib, which names it A352AD10 and W0000501
    assert epson.text([0x3341, 0x3235, 0x4441, 0x3031]) == "A352AD10"
    assert epson.text([0x3057, 0x3030, 0x3530, 0x3130]) == "W0000501"
    assert epson.text([0xFFFF] * 4) == ""


def frames(product: bytes, n: int) -> tuple[list[bytes], list[tuple[float, ...]]]:
    """Frames of samples that all differ, and what they indicate; start and end bytes occur inside them."""
    twin = EpsonTwin(lambda _, n: np.zeros((n, 3), np.int32), lambda _: 0, product=product)
    twin.registers[1][0x0C:0x0E] = struct.pack("<H", 0x0702 if twin.velocity else 0xC703)
    twin.registers[1][0x05] = 4
    axes = [[0x0D0000 + 256 * k, -0x7F7F80 + k, 0x0D800D if k % 2 else -0x728000 - k] for k in range(n)]
    scale = 2.0**22 if twin.velocity else 2.0**24
    return [twin.frame(k, row) for k, row in enumerate(axes)], [tuple(v / scale for v in row) for row in axes]


def read(data: bytes, product: bytes) -> list[tuple[float, ...]]:
    given = {"unit": "m/s", "rate_hz": 3000} if product.startswith(b"A342") else {"unit": "g"}
    stream = EpsonStream(Cutter("s", 200.0), EpsonOptions.model_validate({"port": "p"} | given))
    rows: list[tuple[float, ...]] = []
    for at in range(0, len(data), 61):
        stream.feed(data[at : at + 61], at + 1, at + 1)
        rows += [tuple(row) for block in stream.blocks() for row in block.indications.tolist()]
    return rows


@pytest.mark.one_case
@pytest.mark.parametrize("kind", ["cut", "lost", "added", "flipped"])
@pytest.mark.parametrize("product", [b"A352AD10", b"A342VD10"])
def test_the_way_is_found_within_two_frames(product: bytes, kind: str) -> None:
    """Every byte of a frame damaged. Without a checksum (M-A342) a flip between the ends of a frame is not seen."""
    sent, true = frames(product, 40)
    whole, length = b"".join(sent), len(sent[0])
    for i in range(20 * length, 21 * length):
        if kind == "cut":
            data = [whole[i:]]
        elif kind == "lost":
            data = [whole[:i] + whole[i + 1 :]]
        elif kind == "added":
            data = [whole[:i] + bytes([octet]) + whole[i:] for octet in (0x80, 0x0D, 0x00, 0xFF)]
        else:
            data = [whole[:i] + bytes([whole[i] ^ 1 << bit]) + whole[i + 1 :] for bit in range(8)]
        for one in data:
            rows = read(one, product)
            if kind != "flipped" or product == b"A352AD10":
                assert set(rows) <= set(true)
            assert rows[-1] == true[-1]
            lost = {k for k in range(20 if kind == "cut" else 1, 40) if true[k] not in rows}
            assert lost <= {20, 21}, (i % length, kind, lost)


def test_a_counter_that_jumps_by_no_whole_number_of_samples_is_a_restart() -> None:
    # At 200 Hz the counter rises by 20 a sample; 3596 are 179.8 samples.
    stream = EpsonStream(Cutter("s", 200.0), EpsonOptions.model_validate({"port": "p", "rate_hz": 200.0}))
    for count in (61920, 61940, 0, 20):
        body = struct.pack(">Hi3iH", 0, 0, 1, 2, 3, count)
        stream.feed(b"\x80" + body + struct.pack(">H", sum(struct.unpack(">10H", body)) % 65536) + b"\r", 1, 1)
    found = [(block.first_index, block.n, block.flags) for block in stream.blocks()]
    assert found == [(0, 2, BlockFlags.RESTART), (2, 2, BlockFlags.RESTART)]
