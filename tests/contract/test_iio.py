"""The driver contract on `iio`, with files and a pipe in the layout of the kernel."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.signal.timing import ClockModel
from hw import iio
from hw.block import BlockFlags, SampleBlock
from hw.conformance.sensor import Rig, SensorContract
from hw.iio import MISSING, Iio, IioOptions
from hw.iio_scan import Element, layout
from hw.sensor import ConfigurationError, DeviceLost
from hw.virtual.iio_twin import IioTwin

LAP = 8000


class IioRig(Rig):
    lost = 3  # samples
    stamped = True

    def __init__(self, root: Path, together: int = 1) -> None:
        self.saturated = range(0)
        self.twin = IioTwin(root, self.counts, self.stamps_ns, self.due, stamped=self.stamped, together=together)
        self.sensor = self.build()  # type: ignore[assignment]

    def build(self, **changes: object) -> Iio:
        options = IioOptions.model_validate({"device": "twin345", "rate_hz": self.rate_hz} | changes)
        return Iio("sensor", options, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Iio:  # type: ignore[override]
        return self.build(device="other")

    def counts(self, first: int, n: int) -> NDArray[np.int32]:
        k = np.arange(first, first + n, dtype=np.int32)
        return np.column_stack([k % LAP, -(k // LAP), np.where(np.isin(k, self.saturated), 8191, -5)])

    def stamps_ns(self, first: int, n: int) -> NDArray[np.int64]:
        return np.round(np.arange(first, first + n) * 1e9 / self.rate_hz).astype(np.int64)

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self.twin.serve(self.t_s)

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(np.int64).T
        numbers = x - LAP * y
        assert ((z == -5) | ((z == 8191) & np.isin(numbers, self.saturated))).all()
        return np.asarray(numbers)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.twin.next += self.lost

    def unplug(self) -> None:
        self.twin.unplug()

    def replug(self) -> None:
        self.twin.plug()

    def close(self) -> None:
        self.sensor.close()
        self.twin.unplug()


class UnstampedRig(IioRig):
    lost = 40
    stamped = False

    def blocks(self, seconds: float) -> Iterator[SampleBlock]:
        """As in the base, but a block among whose samples others are missing is dropped."""
        samples, dropped = seconds * self.rate_hz, 0
        while samples > 0:
            block = self.sensor.read_block()
            if block is None:
                dropped += 1
                assert dropped <= 4, "the device fell silent"
            else:
                samples -= block.n
                yield block


def installed(rig: IioRig, monkeypatch: pytest.MonkeyPatch) -> Iterator[IioRig]:
    monkeypatch.setattr(iio, "SYSFS", rig.twin.sysfs)
    monkeypatch.setattr(iio, "DEV", rig.twin.dev)
    yield rig
    rig.close()


class TestIio(SensorContract):
    @pytest.fixture
    def rig(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[IioRig]:
        yield from installed(IioRig(tmp_path), monkeypatch)

    def test_polls_do_not_beat_with_the_sample_clock(self, rig: IioRig) -> None:  # type: ignore[override]
        """Replaced, because the kernel stamps every sample and no poll can beat with the sample clock."""
        rig.open()
        for block in rig.blocks(1.0):
            assert block.burst_count.tolist() == list(range(1, block.n + 1))
            assert block.burst_t_monotonic_ns.tolist() == self.stamps(rig, block.indications)

    def stamps(self, rig: IioRig, indications: NDArray[np.generic]) -> list[int]:
        return [round(number * 1e9 / rig.rate_hz) for number in rig.number(indications).tolist()]

    def test_says_who_it_is_and_how_it_is_set(self, rig: IioRig) -> None:
        info = rig.sensor.open()
        assert (info.kind, info.unit) == ("twin345", "count")
        assert info.nominal_sensitivity == pytest.approx(1 / 0.0383)
        assert info.range_mps2 == pytest.approx(8192 * 0.0383)
        assert info.settings["in_accel_x_calibbias"] == info.settings["in_accel_z_calibbias"] == "0"
        assert info.settings["current_timestamp_clock"] == "monotonic"
        assert (rig.twin.sysfs / "iio:device0/scan_elements/in_temp_en").read_text() == "0"

    @pytest.mark.parametrize(
        ("corner_hz", "stated"),
        [("37.500000", ("lowpass order=1 corner_hz=37.5 u_corner_pct=50",)), ("0.4", ()), ("0", ()), ("inf", ())],
    )
    def test_states_the_low_pass_filter_that_the_kernel_names(
        self, rig: IioRig, corner_hz: str, stated: tuple[str, ...]
    ) -> None:
        (rig.twin.sysfs / "iio:device0/in_accel_filter_low_pass_3db_frequency").write_text(corner_hz)
        info = rig.sensor.open()
        assert info.filters == stated
        assert "in_accel_filter_low_pass_3db_frequency" not in info.settings  # it would be another device

    def test_a_rate_that_the_kernel_driver_rounds_is_refused(
        self, rig: IioRig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(iio, "_text", lambda path: "800.000000" if "frequency" in path.name else path.read_text())
        with pytest.raises(
            ConfigurationError, match=r"in_accel_sampling_frequency: wrote 1000, the kernel driver set 800"
        ):
            rig.sensor.open()

    @pytest.mark.parametrize(
        ("refused", "known", "said"),
        [
            (
                "in_accel_sampling_frequency",
                ("iio:device0/in_accel_sampling_frequency_available", "12.5 26\n"),
                r"in_accel_sampling_frequency: 1000 is refused; accepted values: 12\.5 26$",
            ),
            ("enable", ("trigger0/name", "pace\n"), r"buffer/enable: 1 is refused; .*triggers here: pace\)$"),
        ],
    )
    def test_a_value_that_the_kernel_driver_refuses_is_said_with_what_it_takes(
        self, rig: IioRig, monkeypatch: pytest.MonkeyPatch, refused: str, known: tuple[str, str], said: str
    ) -> None:
        def write(path: Path, text: str) -> int:
            if path.name == refused and text != "0":
                raise OSError(errno.EINVAL, "Invalid argument")  # write(2) reports an error without the file name
            return plain(path, text)

        path = rig.twin.sysfs / known[0]
        path.parent.mkdir(exist_ok=True)
        path.write_text(known[1])
        plain = Path.write_text
        monkeypatch.setattr(Path, "write_text", write)
        with pytest.raises(ConfigurationError, match=said):
            rig.sensor.open()

    def test_a_device_without_a_buffer_is_refused(self, rig: IioRig) -> None:
        shutil.rmtree(rig.twin.sysfs / "iio:device0/buffer")
        with pytest.raises(ConfigurationError, match="iio:device0: the device has no buffer"):
            rig.sensor.open()

    def test_a_device_that_somebody_else_reads_is_left_as_it_is(
        self, rig: IioRig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def busy(path: Path, _flags: int) -> int:
            raise OSError(errno.EBUSY, "Device or resource busy", str(path))

        enable = rig.twin.sysfs / "iio:device0/buffer/enable"
        enable.write_text("1")
        with monkeypatch.context() as patch:
            patch.setattr("hw.iio.os.open", busy)
            with pytest.raises(ConfigurationError, match="iio:device0: Device or resource busy"):
                rig.sensor.open()
        assert enable.read_text() == "1"

    def test_absent_says_what_there_is(self, rig: IioRig) -> None:
        with pytest.raises(DeviceLost, match=r"no IIO device 'other'; available: twin345 \(iio:device0\)"):
            rig.build_elsewhere().open()

    def test_what_the_full_buffer_dropped_is_a_gap_of_known_length_or_a_restart(self, rig: IioRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.twin.next += 50
        rig.sleep(0.06)
        blocks = list(rig.blocks(1.0))
        assert [b.flags for b in (before, *blocks)].count(BlockFlags.GAP) == 1
        assert blocks[-1].first_index + blocks[-1].n - rig.number(blocks[-1].indications)[
            -1
        ] == 1 + before.first_index + (before.n - 1 - rig.number(before.indications)[-1])


class TestWithoutStamps(SensorContract):
    """A kernel driver without a time stamp channel, as adxl372. A loss of fewer samples than two polls are apart is not
    seen."""

    @pytest.fixture
    def rig(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[IioRig]:
        yield from installed(UnstampedRig(tmp_path), monkeypatch)

    def test_says_that_it_has_no_stamps(self, rig: IioRig) -> None:
        assert "current_timestamp_clock" not in rig.sensor.open().settings

    def test_a_full_buffer_is_told_where_it_dropped(self, rig: IioRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        rig.sleep(7.0)
        held, after, *_ = rig.blocks(5.0)
        numbers = [rig.number(block.indications) for block in (before, held, after)]
        assert (held.flags, held.n, numbers[1][0]) == (BlockFlags.NONE, 4096, numbers[0][-1] + 1)
        assert after.flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert numbers[2][0] > numbers[1][-1] + 2000

    def test_a_rate_that_is_another_is_told(self, rig: IioRig) -> None:
        rig.due = lambda t_s: int(t_s * 1500)  # type: ignore[method-assign]
        rig.twin._samples_due = rig.due
        rig.open()
        with pytest.raises(
            DeviceLost, match=r"7[0-9][0-9] samples came in 0\.[45].* s, which is not rate_hz 1000 within"
        ):
            list(rig.blocks(10.0))


class TestTogether:
    """A kernel driver that passes on 16 samples of the chip's FIFO at a time, without stamps, as adxl345."""

    @pytest.fixture
    def rig(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[IioRig]:
        yield from installed(UnstampedRig(tmp_path, together=16), monkeypatch)

    @pytest.mark.slow
    def test_each_lot_is_a_burst_with_its_arrival(self, rig: IioRig) -> None:
        rig.rate_hz, rig.sensor = 200.0, rig.build(rate_hz=200.0)  # type: ignore[assignment]
        rig.open()
        late_s, clock = [], ClockModel(rig.rate_hz)
        for block in rig.blocks(30.0):
            numbers = rig.number(block.indications)
            assert (np.diff(numbers) == 1).all()
            assert block.flags & ~BlockFlags.RESTART == BlockFlags.NONE
            ends = numbers[block.burst_count - 1]
            clock.update(ends, block.burst_t_monotonic_ns * 1e-9)
            assert (ends % 16 == 15).all()
            late_s += (block.burst_t_monotonic_ns * 1e-9 - ends / rig.rate_hz).tolist()
        # Late by less than a poll, and by any part of it: polls do not beat with the interrupts.
        share, _ = np.histogram(late_s, bins=3, range=(0.0, 0.015))
        assert share.sum() == len(late_s)
        assert share[:2].min() >= 0.25 * len(late_s)
        assert rig.sensor.take_drops() == []
        samples = np.arange(int(ends[-1]) - 4000, int(ends[-1]) + 1)
        assert np.abs(clock.result().times_of(int(samples[0]), len(samples)) - samples / rig.rate_hz).max() < 1e-3

    def test_a_fifo_that_the_kernel_read_too_late_is_a_loss(self, rig: IioRig) -> None:
        rig.open()
        *_, before = rig.blocks(5.0)
        rig.twin.next += 64
        (after, *_) = rig.blocks(1.5)
        assert after.flags == BlockFlags.RESTART | BlockFlags.OVERRUN
        assert rig.number(after.indications)[0] > rig.number(before.indications)[-1] + 64
        (drop,) = rig.sensor.take_drops()
        assert (drop.unit, drop.reason) == ("samples", MISSING)


def test_elements_as_the_kernel_states_them() -> None:
    assert Element.parse(0, "le:s12/16>>4").value(np.array([-16, 0x7FF0], np.int16)).tolist() == [-1, 2047]
    assert Element.parse(0, "be:u10/16>>6").value(np.array([0xFFC0], np.uint16)).tolist() == [1023]
    assert Element.parse(0, "le:s20/32>>12").value(np.array([-(2**31)], np.int32)).tolist() == [-(2**19)]
    for several_or_none in ("le:s12/16X2>>4", "le:s0/16>>0", "le:s12/16>>5", "le:s12/16>>4\n", "le:s١/8>>0"):
        with pytest.raises(ConfigurationError, match="is not the type of a scan element"):
            Element.parse(0, several_or_none)
    scan = layout({"b": Element.parse(1, "le:s64/64>>0"), "a": Element.parse(0, "be:s16/16>>0")})
    assert (scan.names, scan.itemsize, scan.fields["b"][1]) == (("a", "b"), 16, 8)  # type: ignore[index]
