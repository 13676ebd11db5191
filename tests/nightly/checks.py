"""The comparisons: values of the kernel and values of fieldcal, row by row."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from hw import adxl345_registers, adxl355_registers, lsm6dso_registers, mpu6050_registers
from hw.fifo_sensor import STANDARD_GRAVITY_MPS2
from hw.virtual.kernel import installed
from tests.nightly.answers import answers, held
from tests.nightly.guest import Guest
from tests.nightly.site import ADDRESSES, Twins
from tests.nightly.tiny_usb import TinyUsb

Counts = tuple[int, int, int]
INDICATIONS: tuple[Counts, ...] = ((1, -1, 0), (100, -200, 16384), (32767, -32768, 12345))
IIO = "/sys/bus/iio/devices"


@dataclass(frozen=True, slots=True)
class Row:
    """One comparison. `agree` is the result; the texts show the values."""

    subject: str
    what: str
    kernel: str
    fieldcal: str
    agree: bool


def same(subject: str, what: str, kernel: str, fieldcal: str) -> Row:
    """A row whose two texts must be equal."""
    return Row(subject, what, kernel, fieldcal, kernel == fieldcal)


class Machine:
    """The virtual machine with the twins on its bus."""

    def __init__(self, guest: Guest, twins: Twins, adapter: TinyUsb) -> None:
        self.guest = guest
        self.twins = twins
        self.adapter = adapter
        name = guest.sh("until ls /dev/i2c-* 2>/dev/null; do sleep 0.1; done", 30.0)
        self.bound: list[str] = []
        self.node = name.split()[0]
        self.bus = int(self.node.removeprefix("/dev/i2c-"))

    def bind(self, kernel_driver: str, device: str) -> str:
        """Bind a kernel driver to a device; returns the directory of its accelerometer."""
        address = ADDRESSES[device]
        self.guest.write(f"/sys/bus/i2c/devices/i2c-{self.bus}/new_device", f"{kernel_driver} 0x{address:02x}")
        found = self.guest.sh(f"ls -d {IIO}/*/in_accel_x_raw | xargs -n 1 dirname | xargs -n 1 readlink -f")
        self.bound.append(device)
        (directory,) = (line for line in found.splitlines() if f"-{address:04x}/" in line)
        return directory

    def hex_of(self, device: str, register: int) -> str:
        """Contents of a register of the twin, in hexadecimal."""
        return f"0x{self.twins.by_name[device].registers[register]:02X}"


def i2c_dev(machine: Machine) -> Iterator[Row]:
    """The twin of i2c-dev answers like the kernel."""
    machine.twins.hold(INDICATIONS[0])
    there = json.loads(machine.guest.python("-m", "tests.nightly.answers", "answers", machine.node))
    with installed({machine.node: machine.twins.bus}):
        here = answers(machine.node)
    for question, answer in here.items():
        yield same("i2c-dev", question, there[question], answer)


def held_address(machine: Machine) -> Iterator[Row]:
    """As `i2c_dev`, after a kernel driver has taken an MPU-6050."""
    address = ADDRESSES["mpu6050"]
    there = json.loads(machine.guest.python("-m", "tests.nightly.answers", "held", machine.node, hex(address)))
    bus = machine.twins.bus
    bus.claimed.add(address)
    with installed({machine.node: bus}):
        here = held(machine.node, address)
    for question, answer in here.items():
        yield same("i2c-dev", question, there[question], answer)


def unplugging(machine: Machine) -> Iterator[Row]:
    """The adapter is removed while its node is open. Expected, as in the twin: EIO, then no node."""
    call = ("-m", "tests.nightly.answers", "gone", machine.node, "/run/open")
    machine.guest.start_python(*call, output="/run/gone")
    machine.guest.sh("until [ -e /host/run/open ]; do sleep 0.1; done")
    machine.adapter.unplug()
    there = json.loads(machine.guest.sh("until [ -s /host/run/gone ]; do sleep 0.1; done; cat /host/run/gone"))
    yield same("i2c-dev", "adapter gone, open node", there["adapter gone, open node"], "EIO")
    yield same("i2c-dev", "adapter gone, opened again", there["adapter gone, opened again"], "ENOENT")


def probe(machine: Machine) -> Iterator[Row]:
    """`fieldcal probe` in the machine: every device on the bus is found with its identity."""
    found = json.loads(machine.guest.python("-m", "agent", "probe", "--bus", str(machine.bus), "--json", "-"))
    said = {answer["address"]: answer["identity"] for answer in found["i2c"][0]["answers"]}
    identities = {
        "adxl355": "ADXL355 (REVID 0x01) or ADXL357 (REVID 0x01)",
        "adxl345": f"ADXL345 (DEVID 0x{adxl345_registers.IDENTITY:02X})",
        "mpu6050": "MPU-6050 (WHO_AM_I 0x68)",
        "lsm6dso": f"LSM6DSO (WHO_AM_I 0x{lsm6dso_registers.IDENTITY:02X})",
    }
    for device, identity in identities.items():
        yield same(device, "fieldcal probe", said.get(ADDRESSES[device], "no answer"), identity)


def mpu6050(machine: Machine) -> Iterator[Row]:
    """inv_mpu6050_i2c against `hw.mpu6050_registers`."""
    twins, guest = machine.twins, machine.guest
    twins.hold(INDICATIONS[0])
    here = machine.bind("mpu6050", "mpu6050")
    yield same("mpu6050", "name", guest.read(f"{here}/name"), "mpu6050")
    yield from raw("mpu6050", machine, here)
    part = mpu6050_registers.PARTS[0x68]
    for range_g, counts in mpu6050_registers.COUNTS_PER_G.items():
        settings = mpu6050_registers.settings(part, 1000.0, range_g)
        # The kernel's table has 598 um/s2 and multiples of it; 2 g / 2^15 is 598.55.
        yield from scale("mpu6050", machine, here, counts / STANDARD_GRAVITY_MPS2, 1e-3)
        register, wanted = mpu6050_registers.ACCEL_CONFIG, settings[mpu6050_registers.ACCEL_CONFIG][1]
        yield same("mpu6050", f"ACCEL_CONFIG at {range_g} g", machine.hex_of("mpu6050", register), f"0x{wanted:02X}")
    for rate_hz in (50.0, 100.0, 200.0, 500.0):
        guest.write(f"{here}/sampling_frequency", f"{rate_hz:g}")
        settings = mpu6050_registers.settings(part, rate_hz, 2)
        for register in (mpu6050_registers.SAMPLE_RATE_DIV, mpu6050_registers.CONFIG):
            name, wanted = settings[register]
            yield same("mpu6050", f"{name} at {rate_hz:g} Hz", machine.hex_of("mpu6050", register), f"0x{wanted:02X}")
    offset, factor = (float(guest.read(f"{here}/in_temp_{what}")) for what in ("offset", "scale"))
    for raw_number in (-26000, -3920, 16000):
        twins.warm("mpu6050", raw_number)
        found = int(guest.read(f"{here}/in_temp_raw"))
        kernel_degc = 1e-3 * (found + offset) * factor
        _, degc = part.temperature(raw_number.to_bytes(2, "big", signed=True))
        # The kernel rounds 36.53 degC to 12420 counts, which are 36.529 degC.
        agree = found == raw_number and abs(kernel_degc - degc) < 0.002
        yield Row("mpu6050", f"temperature {raw_number}", f"{kernel_degc:.3f} degC", f"{degc:.3f} degC", agree)


def lsm6dso(machine: Machine) -> Iterator[Row]:
    """st_lsm6dsx_i2c against `hw.lsm6dso_registers`; the device is already bound."""
    twins, guest = machine.twins, machine.guest
    twins.hold(INDICATIONS[0])
    here = machine.bind("lsm6dsox", "lsm6dso")
    yield same("lsm6dso", "name", guest.read(f"{here}/name"), "lsm6dsox_accel")
    yield from raw("lsm6dso", machine, here)
    for range_g, mg in lsm6dso_registers.MG_PER_COUNT.items():
        # Nine decimals, the last one truncated: 1e-9 of 6e-4.
        yield from scale("lsm6dso", machine, here, 1 / (1e-3 * mg * STANDARD_GRAVITY_MPS2), 2e-6)
        wanted = lsm6dso_registers.settings(104.0, range_g)[lsm6dso_registers.CTRL1_XL][1] & 0x0C
        found = twins.by_name["lsm6dso"].registers[lsm6dso_registers.CTRL1_XL] & 0x0C
        yield same("lsm6dso", f"CTRL1_XL, range {range_g} g", f"0x{found:02X}", f"0x{wanted:02X}")
    for rate_hz in lsm6dso_registers.RATES_HZ[:7]:
        guest.write(f"{here}/sampling_frequency", f"{rate_hz:g}")
        twins.written.clear()
        guest.read(f"{here}/in_accel_x_raw")  # the kernel sets the rate only for this read
        codes = [value & 0xF0 for device, register, value in twins.written if (device, register) == ("lsm6dso", 0x10)]
        wanted = lsm6dso_registers.settings(rate_hz, 2)[lsm6dso_registers.CTRL1_XL][1] & 0xF0
        yield same("lsm6dso", f"CTRL1_XL, {rate_hz:g} Hz", f"0x{max(codes, default=0):02X}", f"0x{wanted:02X}")


def adxl355(machine: Machine) -> Iterator[Row]:
    """adxl355_i2c, if the kernel has it, against `hw.adxl355_registers`."""
    twins, guest, part = machine.twins, machine.guest, adxl355_registers.ADXL355
    twins.hold(INDICATIONS[0])
    here = machine.bind("adxl355", "adxl355")
    yield same("adxl355", "name", guest.read(f"{here}/name"), "adxl355")
    yield from raw("adxl355", machine, here, (*INDICATIONS, (2**19 - 1, -(2**19), 0)))
    # The kernel uses 3.9 ug per count; the data sheet rounds this from 1 g / 256000.
    ours, found = STANDARD_GRAVITY_MPS2 / part.counts_per_g[2], guest.read(f"{here}/in_accel_scale")
    yield Row("adxl355", "m/s2 a count", found, f"{ours:.9f}", abs(float(found) / ours - 1) <= 2e-3)
    for rate_hz in adxl355_registers.RATES_HZ[2:]:
        guest.write(f"{here}/in_accel_sampling_frequency", f"{rate_hz + 1e-9:.3f}")  # the kernel writes 7.8125 as 7.813
        wanted = adxl355_registers.settings(part, rate_hz, 2)[
            adxl355_registers.FILTER - adxl355_registers.FIRST_SETTING
        ]
        found = machine.hex_of("adxl355", adxl355_registers.FILTER)
        yield same("adxl355", f"FILTER at {rate_hz:g} Hz", found, f"0x{wanted:02X}")
    offset, factor = (float(guest.read(f"{here}/in_temp_{what}")) for what in ("offset", "scale"))
    for raw_number in (1400, 1885, 2400):
        twins.warm("adxl355", raw_number)
        number = int(guest.read(f"{here}/in_temp_raw"))
        _, degc = adxl355_registers.temperature(part, raw_number.to_bytes(2, "big"))
        kernel_degc = 1e-3 * (number + offset) * factor
        agree = number == raw_number and abs(kernel_degc - degc) < 0.001
        yield Row("adxl355", f"temperature {raw_number}", f"{kernel_degc:.3f} degC", f"{degc:.3f} degC", agree)


def raw(device: str, machine: Machine, here: str, indications: Iterable[Counts] = INDICATIONS) -> Iterator[Row]:
    """Compare the values in the output registers."""
    for counts in indications:
        machine.twins.hold(counts)
        found = " ".join(machine.guest.read(f"{here}/in_accel_{axis}_raw") for axis in "xyz")
        yield same(device, "raw", found, " ".join(map(str, counts)))


def scale(device: str, machine: Machine, here: str, counts_per_mps2: float, tolerance: float) -> Iterator[Row]:
    """Set the kernel's scale (m/s2 per count) that is nearest to ours and compare it with ours."""
    ours = 1 / counts_per_mps2
    known = machine.guest.read(f"{here}/in_accel_scale_available").split()
    nearest = min(known, key=lambda text: abs(float(text) - ours))
    machine.guest.write(f"{here}/in_accel_scale", nearest)
    found = machine.guest.read(f"{here}/in_accel_scale")
    yield Row(device, "m/s2 a count", found, f"{ours:.9f}", abs(float(found) / ours - 1) <= tolerance)
