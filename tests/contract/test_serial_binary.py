"""The driver contract on `serial-binary`, and the faults that only frames have."""

from __future__ import annotations

import binascii
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.block import BlockFlags, Drop
from hw.conformance.serial import SerialContract, SerialRig
from hw.sensor import DeviceLost
from hw.serial_binary import SerialBinary

LAP = 30_000
FRAME = np.dtype([("start", "S2"), ("sequence", ">u2"), ("x", ">i2"), ("y", ">i2"), ("z", ">i2"), ("t", ">i2")])


class BinaryRig(SerialRig):
    driver = SerialBinary
    rate_hz = 2000.0
    known = {  # noqa: RUF012
        "baud_rate": 921600,
        "start": "aa55",
        "length": 14,
        "byte_order": "big",
        "indications": [{"at": at, "type": "i16"} for at in (4, 6, 8)],
        "sequence": {"at": 2, "type": "u16"},
        "temperature": {"at": 10, "type": "i16", "counts_per_degc": 100.0, "zero_degc": 5.0},
        "checksum": "crc16-ccitt",
        "checksum_order": "big",
        "full_scale": 32767,
    }

    def write(self, first: int, n: int) -> bytes:
        k = np.arange(first, first + n)
        frames = np.zeros(n, FRAME)
        frames["start"] = b"\xaa\x55"
        frames["sequence"] = k % 65536
        frames["x"], frames["y"] = k % LAP, -(k // LAP)
        frames["z"] = np.where(np.isin(k, self.saturated), 32767, 0x55AA - 0x10000 * (0x55AA > 32767))
        frames["t"] = 2000
        return b"".join(self.closed(frame.tobytes()) for frame in frames)

    def closed(self, body: bytes) -> bytes:
        return body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x - LAP * y
        assert ((z == 0x55AA) | ((z == 32767) & np.isin(numbers, self.saturated))).all()
        return numbers


class UncountedRig(BinaryRig):
    known = {key: value for key, value in BinaryRig.known.items() if key != "sequence"}  # noqa: RUF012


class UnmarkedRig(BinaryRig):
    """Frames of 80, x, y, z and 0880: the last byte is 80 too."""

    known = {  # noqa: RUF012
        "baud_rate": 921600,
        "start": "80",
        "length": 9,
        "byte_order": "big",
        "indications": [{"at": at, "type": "i16"} for at in (1, 3, 5)],
    }

    def write(self, first: int, n: int) -> bytes:
        whole = super().write(first, n)
        return b"".join(b"\x80" + whole[at + 4 : at + 10] + b"\x08\x80" for at in range(0, len(whole), 14))


class EndedRig(BinaryRig):
    """Frames of 80, sequence, x, y, z, 0880 and 0D."""

    known = {  # noqa: RUF012
        "baud_rate": 921600,
        "start": "80",
        "end": "0d",
        "length": 12,
        "byte_order": "big",
        "sequence": {"at": 1, "type": "u16"},
        "indications": [{"at": at, "type": "i16"} for at in (3, 5, 7)],
        "full_scale": 32767,
    }

    def write(self, first: int, n: int) -> bytes:
        whole = super().write(first, n)
        return b"".join(b"\x80" + whole[at + 2 : at + 10] + b"\x08\x80\r" for at in range(0, len(whole), 14))


class TestSerialBinary(SerialContract):
    samples = max(SerialContract.samples, 70_000)  # more than its counter of 16 bits has

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[BinaryRig]:
        rig = BinaryRig(tmp_path / "port")
        yield rig
        rig.close()

    @pytest.mark.parametrize("garbage", [b"\x00", b"\xaa", b"\xaa\x55", b"\xaa\x55" * 30, bytes(range(256))])
    def test_garbage_between_frames_costs_no_sample(self, rig: BinaryRig, garbage: bytes) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.port.inject(garbage)
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.number(block.indications)[0] == rig.number(before.indications)[-1] + 1
        assert rig.sensor.take_drops() == [Drop(len(garbage), "bytes", "no frame")]
        assert rig.sensor.take_drops() == []

    def test_a_damaged_frame_is_a_gap_of_one(self, rig: BinaryRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(0.001)
        rig.port.inject(rig.write(rig.next, 1)[:-1] + b"\x00")
        rig.next += 1
        blocks = [before, *rig.blocks(1.0)]
        missing = [b.first_index - a.first_index - a.n for a, b in itertools.pairwise(blocks)]
        assert [bool(b.flags & BlockFlags.GAP) for b in blocks[1:]] == [bool(n) for n in missing]
        assert sum(missing) == 1
        assert rig.sensor.take_drops() == [Drop(14, "bytes", "no frame")]

    def test_temperature(self, rig: BinaryRig) -> None:
        rig.open()
        (block,) = rig.blocks(0.4)
        assert (block.temperature_raw, block.temperature_degc) == (2000, 25.0)

    def test_without_a_sequence_garbage_restarts_where_it_stood(self, tmp_path: Path) -> None:
        rig = UncountedRig(tmp_path / "other")
        try:
            rig.open()
            *_, before = rig.blocks(0.6)
            rig.port.inject(b"\x00\x01")
            after = next(rig.blocks(0.1))
            assert after.flags == BlockFlags.RESTART
            assert after.first_index == before.first_index + before.n
        finally:
            rig.close()

    def test_frames_that_fit_at_two_places_are_a_loss(self, tmp_path: Path) -> None:
        rig = UnmarkedRig(tmp_path / "other")
        try:
            rig.open()
            told = r"other: 2 bytes of each 9 may be the start of a frame \(80\), in \d{5} frames one after the other"
            with pytest.raises(DeviceLost, match=told):
                list(iter(rig.sensor.read_block, "never"))
        finally:
            rig.close()


class TestWithoutChecksum(SerialContract):
    """Frames that only their first and last byte and their sequence tell."""

    samples = min(SerialContract.samples, 100_000)  # it shares code with the frames above, of which more are read

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[EndedRig]:
        rig = EndedRig(tmp_path / "port")
        yield rig
        rig.close()
