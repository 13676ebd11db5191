"""The twins compared with measurements on a real kernel and a real terminal, and with the data sheet."""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from smbus2 import SMBus, i2c_msg

from hw.adxl355 import Adxl355, Adxl355Options
from hw.sensor import DeviceError
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.serial_port import PtyDevice, SampleLines, format_lines


class Memory:
    """256 registers with auto-increment, the simplest possible target."""

    def __init__(self) -> None:
        self.registers = bytearray(range(256))
        self.pointer = 0

    def write(self, data: bytes) -> None:
        self.pointer = data[0]
        self.registers[self.pointer : self.pointer + len(data) - 1] = data[1:]

    def read(self, count: int) -> bytes:
        return bytes((self.registers * (count // 256 + 2))[self.pointer : self.pointer + count])


@pytest.fixture
def adapter() -> Iterator[I2CBus]:
    adapter = I2CBus({0x50: Memory()})
    with installed({"/dev/i2c-3": adapter}):
        yield adapter


def failure(call: object, *arguments: object) -> int | None:
    with pytest.raises(OSError) as raised:  # noqa: PT011 - the test checks the errno
        call(*arguments)  # type: ignore[operator]
    return raised.value.errno


@pytest.mark.usefixtures("adapter")
def test_the_real_smbus2_reads_and_writes() -> None:
    with SMBus(3) as bus:
        assert bus.read_byte_data(0x50, 7) == 7
        bus.write_byte_data(0x50, 7, 99)
        assert bus.read_i2c_block_data(0x50, 6, 3) == [6, 99, 8]
        bus.write_i2c_block_data(0x50, 20, [1, 2, 3])
        answer = i2c_msg.read(0x50, 5)
        bus.i2c_rdwr(i2c_msg.write(0x50, [19]), answer)
        assert bytes(answer) == bytes([19, 1, 2, 3, 23])


@pytest.mark.usefixtures("adapter")
def test_limits_of_the_kernel() -> None:
    with SMBus(3) as bus:
        bus.i2c_rdwr(*[i2c_msg.read(0x50, 1) for _ in range(42)])
        assert failure(bus.i2c_rdwr, *[i2c_msg.read(0x50, 1) for _ in range(43)]) == errno.EINVAL
        bus.i2c_rdwr(i2c_msg.read(0x50, 8192))
        assert failure(bus.i2c_rdwr, i2c_msg.read(0x50, 8193)) == errno.EINVAL


def test_errors_of_the_kernel(adapter: I2CBus) -> None:
    assert failure(SMBus, 4) == errno.ENOENT
    with SMBus(3) as bus:
        assert failure(bus.read_byte_data, 0x51, 0) == errno.EREMOTEIO
        adapter.claimed.add(0x50)
        assert failure(bus.read_byte_data, 0x50, 0) == errno.EBUSY
        bus.i2c_rdwr(i2c_msg.read(0x50, 1))  # a plain transfer is not refused
        assert bus.read_byte_data(0x50, 5, force=True) == 5
        adapter.unplug()
        assert failure(bus.read_byte_data, 0x50, 0) == errno.EIO
        assert failure(SMBus, 3) == errno.ENOENT
        adapter.replug()
        assert failure(bus.i2c_rdwr, i2c_msg.read(0x50, 1)) == errno.EIO
        with SMBus(3) as again:
            again.i2c_rdwr(i2c_msg.read(0x50, 1))


def test_smbus2_is_as_before_afterwards() -> None:
    with installed({"/dev/i2c-3": I2CBus({})}):
        pass
    assert failure(SMBus, "/dev/i2c-no-such") == errno.ENOENT
    with pytest.raises(OSError, match="Inappropriate ioctl"):  # the real ioctl, on a real file
        SMBus("/dev/null")


class Clock:
    t_s = 0.0

    def __call__(self) -> float:
        return self.t_s


def twin(clock: Clock) -> Adxl355Twin:
    def source(first: int, n: int) -> np.ndarray:
        return np.arange(first, first + n, dtype=np.int32)[:, None] + np.zeros(3, np.int32)

    return Adxl355Twin(source, lambda t_s: int(t_s * 1000), clock)


def registers(chip: Adxl355Twin, register: int, count: int) -> bytes:
    chip.write(bytes([register]))
    return chip.read(count)


def test_twin_after_power_on() -> None:
    # Data sheet, reset values: AD 1D ED 01, FIFO_SAMPLES 60, RANGE 81, POWER_CTL 01 (standby).
    chip = twin(Clock())
    assert registers(chip, 0x00, 4).hex() == "ad1ded01"
    assert registers(chip, 0x29, 5).hex() == "6000008101"


def test_twin_takes_settings_in_standby_only() -> None:
    chip = twin(Clock())
    chip.write(b"\x28\x05")
    chip.write(b"\x2d\x00")
    chip.write(b"\x28\x07")
    chip.write(b"\x00\x07")
    assert registers(chip, 0x28, 1) == b"\x05"
    assert registers(chip, 0x00, 1) == b"\xad"


def test_twin_fifo_holds_96_entries_and_tells_once_that_it_ran_over() -> None:
    clock = Clock()
    chip = twin(clock)
    clock.t_s = 10.0
    chip.write(b"\x2d\x00")
    clock.t_s = 10.0325
    assert registers(chip, 0x04, 2) == bytes([0b011, 96])  # full, not overrun
    clock.t_s = 10.0335
    assert registers(chip, 0x04, 2) == bytes([0b111, 96])
    assert registers(chip, 0x04, 2) == bytes([0b011, 96])
    oldest = registers(chip, 0x11, 9)
    assert oldest.hex() == "027111027110027110"  # sample 10001 with the X marker
    assert registers(chip, 0x05, 1) == bytes([93])
    rest = registers(chip, 0x11, 3 * 93 + 3)
    assert rest[-3:] == b"\x00\x00\x02"  # nothing left: an entry marked as empty
    assert registers(chip, 0x04, 2) == bytes([0b000, 0])


def test_twin_needs_time_after_a_reset() -> None:
    clock = Clock()
    chip = twin(clock)
    trim = registers(chip, 0x50, 5)
    chip.write(b"\x2f\x52")
    chip.write(b"\x28\x05")
    assert registers(chip, 0x50, 5) != trim
    clock.t_s += 0.005
    assert registers(chip, 0x50, 5) == trim
    assert registers(chip, 0x28, 1) == b"\x00"


class Noise:
    """Answers every request and fails at times, like a disturbed bus."""

    def __init__(self, seed: int, chip: Adxl355Twin, share: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.chip = chip
        self.share = share

    def _trouble(self) -> bool:
        return bool(self.rng.random() < self.share)

    def write(self, data: bytes) -> None:
        if self._trouble():
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        self.chip.write(data)

    def read(self, count: int) -> bytes:
        data = self.chip.read(count)
        return self.rng.bytes(count) if self._trouble() else data


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.thorough) for k in range(2, 6))])
def test_a_bus_in_trouble_raises_nothing_but_device_errors(seed: int) -> None:
    clock = Clock()
    chip = Noise(seed, twin(clock), 0.0)

    def sleep(seconds: float) -> None:
        clock.t_s += seconds

    driver = Adxl355(
        "sensor", Adxl355Options(), clock=lambda: (round(clock.t_s * 1e9), round(clock.t_s * 1e9)), sleep=sleep
    )
    next_index = blocks = 0
    with installed({"/dev/i2c-1": I2CBus({0x1D: chip})}):
        for _ in range(60):
            try:
                chip.share = 0.0
                driver.open()
                chip.share = 0.1
                for _ in range(5):
                    block = driver.read_block()
                    if block is not None:
                        blocks += 1
                        assert block.first_index == next_index
                        next_index += block.n
            except DeviceError:
                continue
        driver.close()
    assert blocks > 10


@pytest.fixture
def silent_port(tmp_path: Path) -> Iterator[PtyDevice]:
    port = PtyDevice(lambda _: b"hello\n", link=tmp_path / "port")
    yield port
    port.stop()


def read_available(file: int, wanted: int) -> bytes:
    data = b""
    while len(data) < wanted and select.select([file], [], [], 2.0)[0]:
        data += os.read(file, 65536)
    return data


def test_nobody_reads_nothing_is_kept(silent_port: PtyDevice) -> None:
    assert not silent_port.has_reader()
    silent_port.serve()
    file = os.open(silent_port.path, os.O_RDONLY | os.O_NOCTTY)
    assert silent_port.has_reader()
    assert silent_port.lost_bytes == 6
    silent_port.serve()
    assert read_available(file, 6) == b"hello\n"
    os.close(file)
    assert not silent_port.has_reader()


def test_bytes_arrive_as_they_are(silent_port: PtyDevice) -> None:
    file = os.open(silent_port.path, os.O_RDONLY | os.O_NOCTTY)
    silent_port.inject(bytes(range(256)))
    silent_port.serve()
    assert read_available(file, 262) == bytes(range(256)) + b"hello\n"
    os.close(file)


def test_a_reader_that_sleeps_does_not_stop_the_device(silent_port: PtyDevice) -> None:
    file = os.open(silent_port.path, os.O_RDONLY | os.O_NOCTTY)
    for _ in range(20):
        silent_port.inject(b"x" * 5000)
        silent_port.serve()
    assert silent_port.lost_bytes > 50_000  # Linux keeps about 20 kB
    os.close(file)


def test_unplugged_the_path_is_gone_and_the_reader_hung_up(silent_port: PtyDevice) -> None:
    file = os.open(silent_port.path, os.O_RDONLY | os.O_NOCTTY)
    silent_port.unplug()
    assert not os.path.lexists(silent_port.path)
    assert (
        failure(os.read, file, 1) == errno.EIO if not select.select([file], [], [], 0)[0] else os.read(file, 1) == b""
    )
    os.close(file)
    silent_port.serve()
    silent_port.replug()
    file = os.open(silent_port.path, os.O_RDONLY | os.O_NOCTTY)
    silent_port.serve()
    assert read_available(file, 6) == b"hello\n"
    os.close(file)


def test_a_reader_that_closes_the_port_between_two_looks_does_not_end_the_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A regression test. The thread of the device ended, and no later reader got an answer."""
    heard: list[bytes] = []
    port = PtyDevice(lambda _: b"", link=tmp_path / "port", received=heard.append)
    reader = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
    os.close(reader)
    monkeypatch.setattr(port, "_open_for_reading", lambda: True)
    port.serve()
    monkeypatch.undo()
    reader = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
    os.write(reader, b"who?")
    port.serve()
    os.close(reader)
    port.stop()
    assert heard == [b"who?"]


def test_a_path_that_is_taken_is_refused(tmp_path: Path) -> None:
    taken = tmp_path / "port"
    taken.touch()
    with pytest.raises(FileExistsError):
        PtyDevice(lambda _: b"", link=taken)


def test_served_from_a_thread_in_order_and_whole() -> None:
    start_s = time.monotonic()
    values = np.arange(100_000.0)[:, None]
    lines = SampleLines(lambda first, n: values[first : first + n], lambda t_s: int((t_s - start_s) * 2000), decimals=0)
    port = PtyDevice(lines)
    file = os.open(port.path, os.O_RDONLY | os.O_NOCTTY)
    port.start()
    data = read_available(file, 5000)
    port.stop()
    os.close(file)
    greeting, *text = data.split(b"\n")[:-1]
    assert greeting.startswith(b"#")
    assert text == [b"%d,%d" % (k, k) for k in range(len(text))]
    assert port.lost_bytes == 0
    assert not port.path.parent.exists()


def test_format_of_lines() -> None:
    values = np.array([[1.5, -2.25, 3.0], [0.0, 1e-7, -1e6]])
    assert format_lines(values, "%.3f") == b"1.500,-2.250,3.000\n0.000,0.000,-1000000.000\n"
    assert format_lines(values[:, :1], "%.1f", 41) == b"41,1.5\n42,0.0\n"
