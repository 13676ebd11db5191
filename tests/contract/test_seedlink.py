"""The driver contract on `seedlink`, on a twin of a SeedLink server; the twin is checked with ObsPy's client."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hw import miniseed
from hw.block import BlockFlags, Drop
from hw.conformance.network import NetworkRig
from hw.conformance.sensor import EPOCH_NS, SensorContract
from hw.seedlink import Seedlink, SeedlinkOptions
from hw.sensor import ConfigurationError, DeviceLost
from hw.stamped_sensor import ALONE
from hw.virtual.seedlink_twin import SeedLinkTwin, record

LAP = 100_000
CODES = ("ENE", "ENN", "ENZ")
CHANNELS = [f"AM.R1234.00.{code}" for code in CODES]
FULL = 2**22
RECORDS = Path(__file__).parent / "records.mseed"


class SeedLinkRig(NetworkRig):
    def __init__(self) -> None:
        self.saturated = range(0)
        self.server: SeedLinkTwin = SeedLinkTwin(CHANNELS, self.counts, lambda: self.due(self.t_s), 1000, EPOCH_NS)
        self.sensor = self.build()

    def build(self, **changes: object) -> Seedlink:
        known = {"host": "127.0.0.1", "port": self.server.port, "station": "R1234", "channels": CODES}
        options = SeedlinkOptions.model_validate(known | {"rate_hz": self.rate_hz, "full_scale": FULL} | changes)
        return Seedlink("sensor", options, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Seedlink:
        with socket.create_server(("127.0.0.1", 0)) as free:
            return self.build(port=free.getsockname()[1])

    def socket(self) -> socket.socket | None:
        link = getattr(self, "sensor", None) and self.sensor._link  # type: ignore[attr-defined]
        return link._socket if link else None

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n, dtype=np.int32)
        return np.column_stack([k % LAP, -(k // LAP), np.where(np.isin(k, self.saturated), FULL, -5)])

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x - LAP * y
        assert ((z == -5) | ((z == FULL) & np.isin(numbers, self.saturated))).all()
        return np.asarray(numbers)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.server.next += 3

    def send(self, channel: str, first: int, samples: NDArray[np.int32], rate_hz: int = 1000) -> None:
        start_ns = EPOCH_NS + round(first * 1e9 / rate_hz)
        self.server.inject(self.server.packet(record(channel, start_ns, rate_hz, samples)))


class TestSeedlink(SensorContract):
    @pytest.fixture
    def rig(self) -> Iterator[SeedLinkRig]:
        rig = SeedLinkRig()
        yield rig
        rig.close()

    def test_polls_do_not_beat_with_the_sample_clock(self, rig: SeedLinkRig) -> None:  # type: ignore[override]
        """Replaced, because the station stamps its records and no poll can beat with the sample clock."""
        rig.open()
        for block in rig.blocks(2.0):
            last = rig.number(block.indications)[block.burst_count - 1]
            assert block.burst_t_monotonic_ns.tolist() == [round(k * 1e9 / rig.rate_hz) for k in last.tolist()]

    def test_says_what_it_reads(self, rig: SeedLinkRig) -> None:
        info = rig.open()
        assert (info.unit, info.axes, info.nominal_sensitivity) == ("count", 3, None)
        assert info.settings["channels"] == ", ".join(CHANNELS)

    def test_what_the_server_does_not_have(self, rig: SeedLinkRig) -> None:
        rig.sensor = rig.build(station="R9")
        with pytest.raises(ConfigurationError, match="'ERROR' to 'STATION R9 AM'"):
            rig.open()
        rig.sensor = rig.build(channels=["EHZ"])
        with pytest.raises(ConfigurationError, match=r"'ERROR' to 'SELECT 00EHZ\.D'"):
            rig.open()

    def test_a_gap_of_one_axis_is_a_gap_of_all(self, rig: SeedLinkRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        k = rig.server.next
        numbers = np.arange(k, k + 100, dtype=np.int32)
        for code, samples in zip(CHANNELS, rig.counts(k, 100).T, strict=True):
            begin = 40 if code.endswith("ENN") else 0  # the first 40 samples of this axis never come
            rig.send(code, k + begin, samples[begin:])
        rig.server.next += 100
        after = next(rig.blocks(0.05))
        assert (after.flags, after.first_index) == (BlockFlags.GAP, before.first_index + before.n + 40)
        assert rig.number(after.indications)[0] == numbers[40]
        assert rig.sensor.take_drops() == [Drop(80, "samples", ALONE)]

    def test_a_record_that_comes_twice(self, rig: SeedLinkRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        for code, samples in zip(CHANNELS, rig.counts(rig.server.next - 100, 100).T, strict=True):
            rig.send(code, rig.server.next - 100, samples)
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        assert rig.sensor.take_drops() == [Drop(300, "samples", Seedlink.repeated)]

    def test_hostile_records(self, rig: SeedLinkRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        for first in (10**8, -(10**8)):  # a day after and before
            rig.send(CHANNELS[0], first, np.arange(50, dtype=np.int32))
        rig.send("AM.R1234.00.EHZ", rig.server.next, np.arange(7, dtype=np.int32))
        rig.server.inject(b"SL000001" + bytes(512))
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE
        drops = {(drop.unit, drop.count) for drop in rig.sensor.take_drops()}
        assert drops == {("samples", 100), ("samples", 7), ("bytes", 512)}
        rig.server.inject(b"HTTP/1.1 400 Bad Request\r\n" + bytes(520))
        with pytest.raises(DeviceLost, match="is not the header of a SeedLink packet"):
            list(rig.blocks(2.0))

    def test_another_rate_is_told(self, rig: SeedLinkRig) -> None:
        rig.open()
        rig.send(CHANNELS[0], 0, np.arange(7, dtype=np.int32), rate_hz=50)
        with pytest.raises(DeviceLost, match="ENE has 50 Hz, not rate_hz 1000"):
            list(rig.blocks(2.0))

    def test_a_silent_server_is_told(self, rig: SeedLinkRig) -> None:
        rig.server._received = lambda data: b""  # type: ignore[method-assign]  # noqa: ARG005
        with pytest.raises(DeviceLost, match="no answer to 'HELLO'"):
            rig.open()

    @pytest.mark.parametrize("step_s", [0.7, -0.7])
    def test_a_step_of_utc_restarts(self, rig: SeedLinkRig, step_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
        rig.open()
        list(rig.blocks(0.6))
        clock = rig.sensor._clock
        monkeypatch.setattr(rig.sensor, "_clock", lambda: (clock()[0], clock()[1] + round(step_s * 1e9)))
        blocks = [block for block in (rig.sensor.read_block() for _ in range(6)) if block is not None]
        assert [block.flags for block in blocks] == [BlockFlags.RESTART] + [BlockFlags.NONE] * (len(blocks) - 1)
        t_ns = np.concatenate([block.burst_t_monotonic_ns for block in blocks])
        assert (np.diff(t_ns) > 0).all()


def test_records_of_all_encodings() -> None:
    """Made by ObsPy 1.5.1: INT16, INT32, FLOAT32, FLOAT64, Steim 1 and Steim 2, both byte orders."""
    data = RECORDS.read_bytes()
    expected = np.round(1000 * np.sin(np.arange(40) * 0.4) * np.exp(np.arange(40) * 0.1))
    assert len(data) == 12 * 512
    for at in range(0, len(data), 512):
        found = miniseed.decode(data[at : at + 512])
        factor = 8 if at % (6 * 512) == 0 else 1  # INT16 holds an eighth
        np.testing.assert_array_equal(found.samples, np.trunc(expected / factor))
        assert (found.channel, found.rate_hz) == ("AM.R1234.00.ENZ", 12.5)
        assert found.start_ns == 1_767_323_045_678_912_000, "2026-01-02T03:04:05.678912"


def test_a_damaged_record_is_told() -> None:
    steim = RECORDS.read_bytes()[-512:]
    for damaged, said in (
        (steim[:150] + bytes([steim[150] ^ 1]) + steim[151:], "do not lead to the last sample"),
        (steim[:60] + b"\x63" + steim[61:], "encoding 99"),
        (steim[:30] + b"\xff\xff" + steim[32:], "65535 samples"),
        (steim[:20] + b"\x00\x00" + steim[22:], "no year"),
        (steim[:511], "511 bytes"),
    ):
        with pytest.raises(miniseed.RecordError, match=said):
            miniseed.decode(damaged)


def test_the_twin_speaks_as_obspy_understands() -> None:
    client = pytest.importorskip("obspy.clients.seedlink.slclient", reason="ObsPy is not installed (extra seismic)")
    twin = SeedLinkTwin(
        CHANNELS, lambda first, n: np.column_stack([np.arange(first, first + n, dtype=np.int32)] * 3),
        lambda: round((time.monotonic() - began_s) * 1000), 1000, EPOCH_NS,
    )  # fmt: skip
    began_s = time.monotonic()
    found = []

    class Listener(client.SLClient):  # type: ignore[name-defined, misc]
        def packet_handler(self, count: int, packet: object) -> bool:  # noqa: ARG002
            found.append(packet.get_trace())  # type: ignore[attr-defined]
            return len(found) >= 6

    listener = Listener(timeout=10)
    listener.slconn.set_sl_address(f"127.0.0.1:{twin.port}")
    listener.multiselect = "AM_R1234:00ENE 00ENN 00ENZ"
    thread = threading.Thread(target=lambda: (listener.initialize(), listener.run()))
    thread.start()
    try:
        deadline = time.monotonic() + 60
        while thread.is_alive() and time.monotonic() < deadline:
            twin.serve()
            time.sleep(0.005)
    finally:
        twin.unplug()
        thread.join(60)
    assert {trace.id for trace in found} == set(CHANNELS)
    trace = found[0]
    assert trace.stats.sampling_rate == 1000
    first = int(trace.data[0])
    assert trace.data.tolist() == list(range(first, first + 100))
    assert trace.stats.starttime.ns == EPOCH_NS + first * 10**6
