"""Answers of i2c-dev: the same questions go to the kernel in the machine and to its twin, `hw.virtual.kernel`.

As a script in the machine it prints its answers as JSON.
"""

from __future__ import annotations

import errno
import json
import sys
import time
from collections.abc import Callable
from typing import Any

from smbus2 import SMBus, i2c_msg

ADXL355, ADXL345, ABSENT = 0x1D, 0x53, 0x55
GONE_S = 10.0


def answers(path: str) -> dict[str, str]:
    """Answers by question. An ADXL355 must be at 0x1D and no device at 0x55."""
    with SMBus(path) as bus:
        funcs = bus.funcs

        def write(register: int) -> Any:
            return i2c_msg.write(ADXL355, [register])

        def read(count: int) -> bytes:
            message = i2c_msg.read(ADXL355, count)
            bus.i2c_rdwr(write(0), message)
            return bytes(message)

        return {
            "plain I2C": str(bool(funcs & 1)),
            "byte of a register": outcome(lambda: bus.read_byte_data(ADXL355, 0)),
            "block of 32 registers": outcome(lambda: bytes(bus.read_i2c_block_data(ADXL355, 0, 32)).hex()),
            "byte written and read back": outcome(lambda: _written(bus)),
            "4 registers in one transfer": outcome(lambda: read(4).hex()),
            "no device, byte": outcome(lambda: bus.read_byte_data(ABSENT, 0)),
            "no device, transfer": outcome(lambda: bus.i2c_rdwr(i2c_msg.read(ABSENT, 1))),
            "42 messages": outcome(lambda: bus.i2c_rdwr(*[write(0)] * 42)),
            "43 messages": outcome(lambda: bus.i2c_rdwr(*[write(0)] * 43)),
            "4096 bytes": outcome(lambda: len(read(4096))),
            "8193 bytes": outcome(lambda: len(read(8193))),
            "no such node": outcome(lambda: SMBus("/dev/i2c-99")),
        }


def _written(bus: SMBus) -> list[int]:
    bus.write_byte_data(ADXL355, 0x24, 0x5A)
    found = [bus.read_byte_data(ADXL355, 0x24)]
    bus.write_byte_data(ADXL355, 0x24, 0)
    return [*found, bus.read_byte_data(ADXL355, 0x24)]


def held(path: str, address: int) -> dict[str, str]:
    """Answers at an address that a kernel driver holds: reads through i2c-dev, and transfers that it still allows."""
    with SMBus(path) as bus:
        return {
            "held by a kernel driver, byte": outcome(lambda: bus.read_byte_data(address, 0x75)),
            "held by a kernel driver, transfer": outcome(lambda: bus.i2c_rdwr(i2c_msg.write(address, [0x75]))),
        }


def gone(path: str, say_open: Callable[[], object]) -> dict[str, str]:
    """Remove the adapter while its node is open: the answers of a read and of the next opening.

    The read is of the ADXL345, which no kernel driver uses.
    """
    end_s = time.monotonic() + GONE_S
    with SMBus(path) as bus:
        bus.read_byte_data(ADXL345, 0)
        say_open()
        while (first := outcome(lambda: bus.read_byte_data(ADXL345, 0))).isdigit() and time.monotonic() < end_s:
            time.sleep(0.01)
    while (after := outcome(lambda: SMBus(path).close())) != "ENOENT" and time.monotonic() < end_s:
        time.sleep(0.01)
    return {"adapter gone, open node": first, "adapter gone, opened again": after}


def outcome(question: Callable[[], object]) -> str:
    """The result, or the name of the errno."""
    try:
        return str(question())
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))


def main() -> None:
    """Arguments: `answers NODE`, `held NODE ADDRESS` or `gone NODE MARK`; MARK is a file made once the node is open."""
    what, path, *rest = sys.argv[1:]
    match what:
        case "answers":
            found = answers(path)
        case "held":
            found = held(path, int(rest[0], 0))
        case _:
            found = gone(path, lambda: open(rest[0], "w").close())
    print(json.dumps(found))


if __name__ == "__main__":
    main()
