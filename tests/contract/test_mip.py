"""The driver contract on MicroStrain's twins, recorded packets, and the faults that only these devices have."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from hw import mip_packets as mip
from hw.block import BlockFlags, DeviceInfo, Drop
from hw.conformance.serial import SerialContract, SerialRig
from hw.cutting import Cutter
from hw.mip import Mip, MipOptions, MipStream
from hw.sensor import ConfigurationError, DeviceLost, IdentityError
from hw.virtual.mip_twin import MipTwin, packet

LAP = 30_000
Z = struct.unpack(">f", bytes.fromhex("3f756580"))[0]  # the beginning of a packet inside a number


class MipRig(SerialRig):
    driver = Mip
    known = {"baud_rate": 460800}  # noqa: RUF012
    rate_hz = 500.0
    new = True

    def __init__(self, link: Path) -> None:
        self.twin = MipTwin(self.rows, self.due, self.rate_hz, new=self.new)
        super().__init__(link)

    def rows(self, first: int, n: int) -> NDArray[np.float64]:
        k = np.arange(first, first + n)
        z = np.where(np.isin(k, self.saturated), 8.0, Z)
        return np.column_stack([k % LAP / 2**15, -(k // LAP) / 2**10, z])

    def write(self, first: int, n: int) -> bytes:
        raise AssertionError(f"the twin writes samples {first} to {first + n}")

    def received(self, data: bytes) -> None:
        self.twin.received(data)

    def text_due(self, t_s: float) -> bytes:
        self.text = self.noise or self.twin.text_due(t_s)
        return self.text

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = np.asarray(indications, np.float64).T
        numbers = np.asarray(x * 2**15 - LAP * y * 2**10, np.int64)
        assert ((z == Z) | ((z == 8.0) & np.isin(numbers, self.saturated))).all()
        return numbers

    def open(self) -> DeviceInfo:
        info = super().open()
        self.twin.next = self.due(self.t_s)
        return info

    def lose(self) -> None:
        self.twin.next += 3


class OldRig(MipRig):
    new = False


@pytest.fixture(params=[MipRig, OldRig])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[MipRig]:
    rig = request.param(tmp_path / "port")
    yield rig
    rig.close()


class TestFromCv7On(SerialContract):
    samples = min(SerialContract.samples, 100_000)  # it shares code with serial-binary, whose test reads more

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[MipRig]:
        rig = MipRig(tmp_path / "port")
        yield rig
        rig.close()


class TestUpToGx5(SerialContract):
    samples = min(SerialContract.samples, 100_000)

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[MipRig]:
        rig = OldRig(tmp_path / "port")
        yield rig
        rig.close()

    def test_saturated_blocks_say_so(self, rig: MipRig) -> None:  # type: ignore[override]
        """These devices do not tell their range: nothing can be marked, and the range is left open."""
        rig.saturate(800, 800)
        assert rig.open().range_mps2 is None
        assert not any(block.flags & BlockFlags.SATURATED for block in rig.blocks(4.0))


def test_says_who_it_is_and_how_it_is_set(rig: MipRig) -> None:
    info = rig.open()
    assert (info.kind, info.serial_number) == (
        ("3DM-CV7-AHRS", "6286.123456") if rig.new else ("3DM-GX5-25", "6253.54321")
    )
    assert (info.unit, info.nominal_sensitivity) == ("g", pytest.approx(1 / 9.80665, rel=1e-12))
    assert info.settings["decimation"] == "2"
    assert info.filters == (("lowpass corner_hz=250 u_corner_pct=50",) if rig.new else ("lowpass corner_hz=250",))
    assert info.range_mps2 == (pytest.approx(8 * 9.80665, rel=1e-12) if rig.new else None)
    twin = rig.twin
    assert (twin.format, twin.filter) == ([(0xD5 if rig.new else 0x12, 2), (0x04, 2)], (True, False))
    assert (twin.bias, twin.to_vehicle, twin.streams) == (bytes(12), bytes(12), {0x80})
    rig.sensor.close()
    rig.port.serve()
    assert not twin.sending


def test_a_rate_that_is_no_part_of_the_base_rate(rig: MipRig) -> None:
    with pytest.raises(
        ConfigurationError, match=r"300 is no whole part of the base rate, 1000 Hz; use for example .*1000"
    ):
        rig.build(rate_hz=300).open()


@pytest.mark.parametrize(("noise", "said"), [(b"", "nothing"), (b"hello, world\n", "bytes without an answer")])
def test_no_sensor(rig: MipRig, noise: bytes, said: str) -> None:
    rig.noise, rig.twin.sending = noise, False
    rig.twin.received = lambda data: None  # type: ignore[method-assign]  # noqa: ARG005
    with pytest.raises(IdentityError, match=rf"no MIP device at 460800 baud \(received: .*{said}"):
        rig.sensor.open()


def test_a_command_that_is_refused(rig: MipRig) -> None:
    rig.twin._write = lambda command, data: (3,)  # type: ignore[method-assign]  # noqa: ARG005
    with pytest.raises(ConfigurationError, match=r"command 0x0C,0x0[8F]: the sensor does not take its value"):
        rig.open()


def test_a_format_that_does_not_take(rig: MipRig) -> None:
    rig.twin._write = lambda command, data: (0,)  # type: ignore[method-assign]  # noqa: ARG005
    with pytest.raises(ConfigurationError, match="does not hold its message format"):
        rig.open()


def test_missing_samples_are_counted_by_the_clock(rig: MipRig) -> None:
    rig.open()
    *_, before = rig.blocks(0.6)
    rig.twin.next += 7
    rig.sleep(0.04)
    after = next(rig.blocks(0.1))
    assert after.flags == BlockFlags.GAP
    assert after.first_index == before.first_index + before.n + 7


@pytest.mark.one_case
def test_power_lost_underway(rig: MipRig) -> None:
    rig.open()
    list(rig.blocks(11.0))
    rig.twin.power_cycle()
    rig.twin.format = [(0xD5 if rig.new else 0x12, 2), (0x04, 2)]
    with pytest.raises(DeviceLost, match=r"did it lose power\?"):
        list(rig.blocks(1.0))
    rig.open()
    assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART
    assert rig.twin.bias == bytes(12)


def test_garbage_between_packets_costs_no_sample(rig: MipRig) -> None:
    rig.open()
    *_, before = rig.blocks(0.6)
    garbage = b"\x75\x65\x80\x03\x75"
    rig.port.inject(garbage)
    block = next(rig.blocks(0.1))
    assert block.flags == BlockFlags.NONE
    assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
    assert rig.sensor.take_drops() == [Drop(len(garbage), "bytes", "no frame")]


def test_what_a_port_cannot_carry() -> None:
    with pytest.raises(ValidationError, match="170000 bit/s; baud_rate is only 115200"):
        MipOptions.model_validate({"port": "p", "rate_hz": 500})


# Packets that a sensor sent, from the file test/data/mip_data.bin of mip_sdk. Each number was worked by hand from the
# bits of IEEE 754: whole number times a power of two.
RECORDED = [
    (
        "756580300ad500000041d8bae0400ad600000000007a12000e043c8eaf72bbda6818bf7c52e80e05bb469ccf39a34c8bbb8be12fd771",
        0x41D8BAE040,
        [(9351026, -29), (-14313496, -31), (-16536296, -24)],
    ),
    (
        "756580300ad500000042af4e84400ad600000000007a12000e043c33a945bead2757bf6dc10a0e053f2b9813bf4067003ca5ebe76898",
        0x42AF4E8440,
        [(11774277, -30), (-11347799, -25), (-15581450, -24)],
    ),
    (
        "756580300ad50000004385e228400ad600000000007a12000e04be9228983f021ed1bf48fbee0e05bf23bde53d7febd03ef80f29a5d3",
        0x4385E22840,
        [(-9578648, -25), (8527569, -24), (-13171694, -24)],
    ),
    (
        "756580300ad5000000445c75cc400ad600000000007a12000e04becf1975be75751dbf5f60ae0e05bde2fdc73d87da2c3d10b677cec4",
        0x445C75CC40,
        [(-13572469, -25), (-16086301, -26), (-14639278, -24)],
    ),
    (
        "756580300ad500000045330970400ad600000000007a12000e043ca7a615bc0fa4cbbf7bfd9c0e05bb0c56d239c57f903caa7fc5fc50",
        0x4533097040,
        [(10987029, -29), (-9413835, -30), (-16514460, -24)],
    ),
    (
        "756580300ad500000046099d14400ad600000000007a12000e04be1bc64e3daa0e10bf7fa8cf0e053f1723b4be20a8c4bd47eebc06a3",
        0x46099D1440,
        [(-10208846, -26), (11144720, -27), (-16754895, -24)],
    ),
    (
        "756580300ad500000046e030b8400ad600000000007a12000e04bc1e38053dc2c02fbf806b5e0e05bead88583e2200843e76dc7b8f41",
        0x46E030B840,
        [(-10369029, -30), (12763183, -27), (-8416094, -23)],
    ),
    (
        "756580300ad500000047b6c45c400ad600000000007a12000e043c8badf5bb9cb193bf7c71460e05bb3c9d9b38c6d982bb8985019f3e",
        0x47B6C45C40,
        [(9154037, -29), (-10269075, -31), (-16544070, -24)],
    ),
]
NUMBERS = [
    ("00000000", 0.0),
    ("80000000", 0.0),
    ("3f800000", 1.0),
    ("bf800000", -1.0),
    ("41000000", 8.0),
    ("c2200000", -40.0),
    ("00000001", 2.0**-149),
    ("3f7fffff", 1.0 - 2.0**-24),
]


@pytest.mark.parametrize(("data", "reference_ns", "numbers"), RECORDED)
def test_recorded_packets(data: str, reference_ns: int, numbers: list[tuple[int, int]]) -> None:
    (whole,) = mip.packets(mip.find(bytes.fromhex(data)))
    rows, times_s, which = mip.samples([whole], mip.REFERENCE_TIME)
    assert rows.tolist() == [[mantissa * 2.0**exponent for mantissa, exponent in numbers]]
    assert times_s[0] == pytest.approx(reference_ns * 1e-9, abs=1e-9)
    assert which.tolist() == [0]


@pytest.mark.parametrize(("data", "g"), NUMBERS)
def test_numbers(data: str, g: float) -> None:
    whole = packet(0x80, (0x04, bytes.fromhex(data) * 3), (0x12, struct.pack(">dHH", 12.5, 0, 0)))
    rows, times_s, _ = mip.samples([whole], mip.GPS_TIME)
    assert rows.tolist() == [[g, g, g]]
    assert times_s.tolist() == [12.5]


@pytest.mark.parametrize(
    ("made", "data"),
    [
        # mip_sdk, test/c/mip/test_mip_format.c and test/data/packet_example_cpp_check.txt
        (mip.packet(0x01, (0x01, b"")), "75650102 0201 E0C6"),
        (mip.packet(0x01), "75650100 DB05"),
        (
            mip.packet(0x0C, (0x0F, bytes.fromhex("018003D5000A04000A05000A"))),
            "75650C0E0E0F018003D5000A04000A05000A91CE",
        ),
        (
            mip.packet(0x0C, (0x0D, bytes.fromhex("8003D50405".replace("8003", "008003")))),
            "75650C08080D008003D504056446",
        ),
    ],
)
def test_packets_of_commands(made: bytes, data: str) -> None:
    assert made == bytes.fromhex(data)


def test_answers() -> None:
    # A device's answer to resume, and the fields of a command that it does not know before it: mip_data.bin
    assert mip.answer(bytes.fromhex("7565010404f10600da74"), mip.BASE, mip.RESUME) == (0, b"")
    both = packet(0x01, (0xF1, b"\x09\x01"), (0xF1, b"\x03\x00"), (0x81, b"12"))
    assert mip.answer(both, mip.BASE, mip.DEVICE_INFO) == (0, b"12")
    assert mip.answer(both, mip.BASE, 0x09) == (1, b"")
    assert mip.answer(both[:-1], mip.BASE, mip.DEVICE_INFO) is None


@pytest.mark.parametrize("payload", ["0e0401", "0004", "01", "0304ff02", "0204 00"])
def test_fields_that_do_not_fill_the_packet_are_no_packet(payload: str) -> None:
    inside = bytes.fromhex(payload)
    body = b"\x75\x65\x80" + bytes([len(inside)]) + inside
    a = b = 0
    for octet in body:
        a = (a + octet) % 256
        b = (b + a) % 256
    assert len(mip.find(body + bytes([a, b])).start) == 0


def test_a_checksum_that_ends_as_a_packet_begins() -> None:
    last = [packet(0x80, (0x04, bytes([0] * 11 + [i]))) for i in range(256)]
    (whole,) = [one for one in last if one[-1] == 0x75]
    found = mip.find(whole)
    assert (len(found.start), found.dropped, found.rest) == (1, 0, b"")
    assert mip.find(whole + b"\x75").rest == b"\x75"


def read(data: bytes, piece: int = 61) -> list[tuple[float, ...]]:
    stream = MipStream(Cutter("s", 500.0), 500.0)
    stream.clock = mip.REFERENCE_TIME
    rows: list[tuple[float, ...]] = []
    for at in range(0, len(data), piece):
        stream.feed(data[at : at + piece], at + 1, at + 1)
        rows += [tuple(row) for block in stream.blocks() for row in block.indications.tolist()]
    return rows


@pytest.mark.one_case
@pytest.mark.parametrize("kind", ["cut", "lost", "added", "flipped"])
def test_the_way_is_found_within_two_packets(kind: str) -> None:
    """Every byte of a packet damaged. The search holds packets back as long as a wrong length asks for more bytes."""
    twin = MipTwin(lambda _, n: np.zeros((n, 3)), lambda _: 0, 500.0, new=True)
    twin.format, twin.streams = [(0xD5, 2), (0x04, 2)], {0x80}
    true = [(k / 2**15, -0.25, Z) for k in range(50)]
    sent = [twin.sample(k, list(row)) for k, row in enumerate(true)]
    whole, length = b"".join(sent), len(sent[0])
    for i in range(20 * length, 21 * length):
        if kind == "cut":
            data = [whole[i:]]
        elif kind == "lost":
            data = [whole[:i] + whole[i + 1 :]]
        elif kind == "added":
            data = [whole[:i] + bytes([octet]) + whole[i:] for octet in (0x75, 0x65, 0x00, 0xFF)]
        else:
            data = [whole[:i] + bytes([whole[i] ^ 1 << bit]) + whole[i + 1 :] for bit in range(8)]
        for one in data:
            rows = read(one)
            assert set(rows) <= set(true)
            lost = {k for k in range(20 if kind == "cut" else 0, 40) if true[k] not in rows}
            assert lost <= {20, 21}, (i % length, kind, lost)


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=30),
            st.binary(min_size=12, max_size=12).map(lambda data: packet(0x80, (0x04, data), (0xD5, bytes(8)))),
        ),
        max_size=12,
    )
)
def test_any_bytes_pass_through(parts: list[bytes]) -> None:
    for row in read(b"".join(parts), piece=17):
        assert np.isfinite(row).all()


def test_a_week_of_gps_ends(tmp_path: Path) -> None:
    """The twin's week ends 0.5 s after its sample 2000."""
    rig = OldRig(tmp_path / "port")
    rig.twin._zero = 2000
    try:
        rig.open()
        blocks = list(rig.blocks(6.0))
        assert {block.flags for block in blocks[1:]} == {BlockFlags.NONE}
    finally:
        rig.close()
