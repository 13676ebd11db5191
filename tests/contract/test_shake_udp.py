"""The driver contract on `shake-udp`, on a twin of a Raspberry Shake; datagrams that a real one sent."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from hw import shake_datagram
from hw.block import BlockFlags, Drop, SampleBlock
from hw.conformance.sensor import EPOCH_NS, Rig, SensorContract, check_shape
from hw.message_sensor import OUTSIDE
from hw.sensor import ConfigurationError, DeviceLost
from hw.shake_udp import NOT_ASKED, OTHERS, UNREADABLE, ShakeUdp, ShakeUdpOptions
from hw.stamped_sensor import ALONE
from hw.virtual.shake_twin import ShakeTwin, datagram

LAP = 100_000
CHANNELS = ("ENE", "ENN", "ENZ")
FULL = 2**22
PERIOD_NS = 10**6  # at 1000 Hz
# Datagrams of the station AM.R24FA on 2020-01-30 (rsudp, rsudp/test/testdata), and by its records in miniSEED
# (rsudp/test/testdata.ms): channel, UTC in ms, first count, last count, sum of the 25 counts.
DATAGRAMS = (Path(__file__).parent / "shake_datagrams.txt").read_bytes().splitlines(keepends=True)
RECORDS = [
    ("EHZ", 1580372810003, 16235, 16221, 407371),
    ("ENE", 1580372810003, -244503, -247202, -6151734),
    ("ENN", 1580372810003, -330489, -329143, -8259392),
    ("ENZ", 1580372810003, 3579629, 3581087, 89512121),
    ("EHZ", 1580372810253, 16273, 16232, 407500),
    ("ENE", 1580372810253, -247256, -244863, -6134608),
    ("ENN", 1580372810253, -331588, -330513, -8267077),
    ("ENZ", 1580372810253, 3580820, 3579876, 89517982),
    ("EHZ", 1580372810503, 16306, 16312, 406949),
    ("ENE", 1580372810503, -245093, -243734, -6140661),
    ("ENN", 1580372810503, -331342, -330057, -8277379),
    ("ENZ", 1580372810503, 3581811, 3581091, 89517954),
    ("EHZ", 1580372810753, 16369, 16325, 407243),
    ("ENE", 1580372810753, -246962, -245769, -6140996),
    ("ENN", 1580372810753, -333294, -330803, -8258079),
    ("ENZ", 1580372810753, 3581244, 3580269, 89525855),
    ("EHZ", 1580372811003, 16270, 16315, 406852),
    ("ENE", 1580372811003, -245089, -246318, -6145235),
    ("ENN", 1580372811003, -329339, -330053, -8267660),
    ("ENZ", 1580372811003, 3579888, 3580381, 89516318),
    ("EHZ", 1580372811253, 16262, 16291, 406688),
    ("ENE", 1580372811253, -246132, -244658, -6147937),
    ("ENN", 1580372811253, -332869, -331541, -8269505),
    ("ENZ", 1580372811253, 3579480, 3580863, 89515350),
]


class ShakeRig(Rig):
    sensor: ShakeUdp

    def __init__(self) -> None:
        self.saturated = range(0)
        self.twin = ShakeTwin(CHANNELS, self.counts, lambda: self.due(self.t_s), self.rate_hz, EPOCH_NS)
        self.sensor = self.build()

    def build(self, **changes: object) -> ShakeUdp:
        known = {"port": self.twin.port, "listen": "127.0.0.1", "channels": CHANNELS}
        options = ShakeUdpOptions.model_validate(known | {"rate_hz": self.rate_hz, "full_scale": FULL} | changes)
        return ShakeUdp("sensor", options, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> ShakeUdp:
        return self.build(listen="192.0.2.1")  # of no computer (RFC 5737)

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self.twin.serve()

    def blocks(self, seconds: float) -> Iterator[SampleBlock]:
        """As in the base, but a Shake that is gone is silent for a while before the driver calls it lost."""
        samples = seconds * self.rate_hz
        while samples > 0:
            block = self.sensor.read_block()
            assert block is not None or not self.twin.plugged, "the device fell silent"
            if block is not None:
                samples -= block.n
                yield block

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
        self.twin.next += 25

    def unplug(self) -> None:
        self.twin.plugged = False

    def replug(self) -> None:
        self.twin.plugged = True

    def close(self) -> None:
        self.sensor.close()
        self.twin.close()

    def after(self, *sent: bytes) -> tuple[SampleBlock, set[Drop]]:
        """The next block that follows these datagrams, and what was dropped until then."""
        for data in sent:
            self.twin.send(data)
        block = next(self.blocks(0.1))
        return block, set(self.sensor.take_drops())


class TestShakeUdp(SensorContract):
    @pytest.fixture
    def rig(self) -> Iterator[ShakeRig]:
        rig = ShakeRig()
        yield rig
        rig.close()

    def test_polls_do_not_beat_with_the_sample_clock(self, rig: ShakeRig) -> None:  # type: ignore[override]
        """Replaced, because the Shake stamps its datagrams and no poll can beat with the sample clock."""
        rig.open()
        for block in rig.blocks(2.0):
            last = rig.number(block.indications)[block.burst_count - 1]
            assert block.burst_t_monotonic_ns.tolist() == [k * PERIOD_NS for k in last.tolist()]

    def test_what_came_before_the_loss_is_returned_first(self, rig: ShakeRig) -> None:  # type: ignore[override]
        """Replaced, because nothing but silence tells that a Shake is gone."""
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(0.2)
        sent = rig.twin.next
        rig.unplug()
        (after,) = rig.blocks(0.1)
        assert rig.number(after.indications).tolist() == list(range(int(rig.number(before.indications)[-1]) + 1, sent))
        with pytest.raises(DeviceLost, match="no datagram with these channels came for 5 s"):
            list(rig.blocks(1.0))

    def test_says_what_it_reads(self, rig: ShakeRig) -> None:
        info = rig.open()
        assert (info.unit, info.axes, info.nominal_sensitivity) == ("count", 3, None)
        assert (info.settings["channels"], info.settings["quantity"]) == ("ENE, ENN, ENZ", "acceleration")

    def test_one_channel_of_several(self, rig: ShakeRig) -> None:
        rig.sensor = rig.build(channels=["ENN"])
        assert rig.open().axes == 1
        block = next(rig.blocks(0.4))
        check_shape(block, 1)
        assert set(rig.sensor.take_drops()) >= {Drop(2 * block.n, "samples", NOT_ASKED)}

    def test_a_datagram_that_is_lost_is_a_gap_of_all_axes(self, rig: ShakeRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        first = rig.twin.next
        for data in (rig.twin.datagrams(first)[0], rig.twin.datagrams(first)[2]):
            rig.twin.send(data)
        rig.twin.next += 25
        after = next(rig.blocks(0.05))
        assert (after.flags, after.first_index) == (BlockFlags.GAP, before.first_index + before.n + 25)
        assert rig.number(after.indications)[0] == first + 25
        assert rig.sensor.take_drops() == [Drop(50, "samples", ALONE)]

    def test_datagrams_that_come_twice(self, rig: ShakeRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        block, drops = rig.after(*rig.twin.datagrams(rig.twin.next - 25))
        assert block.flags == BlockFlags.NONE
        assert drops == {Drop(75, "samples", ShakeUdp.repeated)}

    def test_datagrams_in_another_order_never_shift_an_axis(self, rig: ShakeRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        first = rig.twin.next
        one, two = rig.twin.datagrams(first), rig.twin.datagrams(first + 25)
        rig.twin.next += 50
        after, drops = rig.after(one[0], two[1], one[1], one[2], two[0], two[2])
        assert rig.number(after.indications)[0] == first + 25  # fails where the axes are of different samples
        assert (after.flags, after.first_index) == (BlockFlags.GAP, before.first_index + before.n + 25)
        assert drops == {Drop(25, "samples", ShakeUdp.repeated), Drop(50, "samples", ALONE)}

    def test_datagrams_of_another_time(self, rig: ShakeRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        samples = np.arange(25, dtype=np.int32)
        away_ns = [round(s * 1e9) for s in (-3600, -61, 1.5, 86400)]
        block, drops = rig.after(*(datagram("ENZ", rig.twin.start_ns(rig.twin.next) + ns, samples) for ns in away_ns))
        assert block.flags == BlockFlags.NONE
        assert drops == {Drop(100, "samples", OUTSIDE)}

    @pytest.mark.parametrize("source", ["", "127.0.0.1"])
    def test_another_sender_is_not_used(self, rig: ShakeRig, source: str) -> None:
        rig.sensor = rig.build(source=source)
        if source:
            rig.twin.send(rig.twin.datagrams(10**6)[0], source="127.0.0.2")  # before the Shake itself
        rig.open()
        list(rig.blocks(0.6))
        rig.sensor.take_drops()
        forged = rig.twin.datagrams(rig.twin.next)[1]
        rig.twin.send(forged, source="127.0.0.2")
        block, drops = rig.after()
        assert block.flags == BlockFlags.NONE
        assert drops == {Drop(len(forged), "bytes", OTHERS)}

    def test_hostile_text_is_counted(self, rig: ShakeRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        block, drops = rig.after(*HOSTILE)
        assert block.flags == BlockFlags.NONE
        assert drops == {Drop(sum(map(len, HOSTILE)), "bytes", UNREADABLE)}

    def test_a_flood_costs_samples_but_never_shifts_them(self, rig: ShakeRig) -> None:
        rig.open()
        list(rig.blocks(0.6))
        for _ in range(5000):
            rig.twin.send(b"x" * 1000)
        numbers = np.concatenate([rig.number(block.indications) for block in rig.blocks(1.0)])
        assert (np.diff(numbers) >= 1).all()
        (flood,) = [drop for drop in rig.sensor.take_drops() if drop.reason == UNREADABLE]
        assert flood.count < 10**6  # the kernel kept what fits the socket, and no more

    def test_another_rate_is_told(self, rig: ShakeRig) -> None:
        for rate_hz in (500, 2000):
            rig.sensor.close()
            rig.sensor = rig.build(rate_hz=rate_hz)
            rig.open()
            with pytest.raises(DeviceLost, match=f"EN. sends 25 samples at a time, .* at rate_hz {rate_hz}; state"):
                list(rig.blocks(2.0))

    def test_channels_that_do_not_come_are_told_with_those_that_do(self, rig: ShakeRig) -> None:
        with pytest.raises(
            DeviceLost, match=r"no datagram with these .* other channels that came: ENE, ENN, ENZ; state"
        ):
            rig.build(channels=["EHZ"]).open()

    def test_a_port_that_another_program_has(self, rig: ShakeRig) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", rig.twin.port))
            with pytest.raises(ConfigurationError, match="another program receives at this port; end it, or"):
                rig.open()

    @pytest.mark.parametrize("step_s", [0.7, -0.7])
    def test_a_step_of_utc_restarts(self, rig: ShakeRig, step_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
        rig.open()
        list(rig.blocks(0.6))
        clock = rig.sensor._clock
        monkeypatch.setattr(rig.sensor, "_clock", lambda: (clock()[0], clock()[1] + round(step_s * 1e9)))
        blocks = [block for block in (rig.sensor.read_block() for _ in range(6)) if block is not None]
        assert [block.flags for block in blocks] == [BlockFlags.RESTART] + [BlockFlags.NONE] * (len(blocks) - 1)


HOSTILE = [
    b"", b"{}", b"TERM", b"ALARM 2020-02-23T06:56:40.598944Z", b"{'EHZ'}", b"{'ENE', 1582315130.292}",
    b"{'ENE', 1582315130.292, }", b"{'ENE', 1582315130.292, 1, 2", b"'ENE', 1582315130.292, 1, 2}",
    b"{'ENE', nan, 1}", b"{'ENE', -1.5, 1}", b"{'ENE', 1e9, 1}", b"{'ENE', 99999999999.0, 1}",
    b"{'ENE', 1582315130.292, 2147483648}", b"{'ENE', 1582315130.292, 1.5}", b"{'ENE', 1582315130.292, 0x10}",
    b"{'ENE', 1582315130.292, __import__('os').abort()}", b"{'ENE', 1582315130.292, 1}{'ENE', 1582315130.292, 1}",
    b"{'ene', 1582315130.292, 1}", b"{'ENEE', 1582315130.292, 1}", b"\xff" * 1000, b"{'ENE', " * 8000,
    "{'ENE', 1582315130.292, \u0661}".encode(), b"{'ENE', 1582315130.292, 1}" + b" " * 3, b"{" * 60000,
]  # fmt: skip


@pytest.mark.parametrize(("data", "record"), list(zip(DATAGRAMS, RECORDS, strict=True)))
def test_a_datagram_of_a_real_shake(data: bytes, record: tuple[str, int, int, int, int]) -> None:
    found = shake_datagram.decode(data)
    counts = found.samples.tolist()
    assert (found.channel, found.start_ns // 10**6, counts[0], counts[-1], sum(counts)) == record
    assert (len(counts), found.start_ns % 10**6, found.samples.dtype) == (25, 0, np.int32)


def test_datagrams_with_the_ends_of_the_range() -> None:
    for data, start_ns, counts in (
        (b"{'EHZ', 1547497409.05, 610, 614}", 1_547_497_409_050_000_000, [610, 614]),
        (b"{'EHZ', 1582315130, -1, 0}\r\n", 1_582_315_130_000_000_000, [-1, 0]),
        (b"{'SHZ',0.000000001,2147483647,-2147483648}", 1, [2**31 - 1, -(2**31)]),
    ):
        found = shake_datagram.decode(data)
        assert (found.start_ns, found.samples.tolist()) == (start_ns, counts)


@pytest.mark.slow
@pytest.mark.parametrize("at", range(0, len(DATAGRAMS[1].rstrip()), 1))
def test_a_datagram_that_is_cut_is_none(at: int) -> None:
    with pytest.raises(shake_datagram.DatagramError):
        shake_datagram.decode(DATAGRAMS[1][:at])


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        (["EHZ", "ENN", "ENE"], "EHZ, ENN, ENE are of a geophone and of an accelerometer; give those of one"),
        (["HDF"], "each channel begins with EH, SH, EN, as ENZ does, not HDF"),
        (["ENZ", "ENZ", "ENE"], "1 or 3 different channels are needed"),
    ],
)
def test_channels_that_are_no_acceleration_or_velocity(channels: list[str], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        ShakeUdpOptions.model_validate({"channels": channels})


def test_a_geophone_is_a_reference_of_velocity() -> None:
    of = {name: ShakeUdpOptions.model_validate({"channels": [name]}) for name in ("EHZ", "SHZ", "ENZ")}
    assert [options.quantity for options in of.values()] == ["velocity", "velocity", "acceleration"]
    assert "state counts per m/s, from" in of["EHZ"].asked_of_certificate
