"""An Epson accelerometer or vibration sensor at the level of its bytes, for `PtyDevice`."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

CONFIGURATION, SAMPLING = 1, 0
RATES_HZ = {2: 1000, 3: 500, 4: 200, 5: 100, 6: 50}
FACTORY = {  # of an M-A352, window 1, by address; the low byte first
    0x00: 0x8E04, 0x02: 0x0026, 0x04: 0x0400, 0x06: 0x0008, 0x08: 0x0100, 0x0A: 0, 0x0C: 0x4702, 0x1C: 0, 0x1E: 0x000A,
    **dict.fromkeys(range(0x2C, 0x38, 2), 0), **dict.fromkeys(range(0x46, 0x4C, 2), 0x0FF1), 0x72: 0x000D,
}  # fmt: skip


class EpsonTwin:
    """A sensor that makes one sample every 1 / `rate_hz`; `text_due` and `received` are arguments of `PtyDevice`.

    `source(first, n)` returns (n, 3) counts, `samples_due(t_s)` the number of samples that exist at `t_s`. The sensor
    sends samples in sampling mode alone, and then takes no command but one that changes the mode or the window.
    """

    def __init__(
        self,
        source: Callable[[int, int], NDArray[np.int32]],
        samples_due: Callable[[float], int],
        *,
        product: bytes = b"A352AD10",
        serial_number: bytes = b"W0000501",
    ) -> None:
        self._source = source
        self._samples_due = samples_due
        self._product = product
        self._serial_number = serial_number
        self.velocity = product.startswith(b"A342")
        self.next = 0
        self.error = False  # the flag EA of the frames
        self.temperature = 2634  # 25 degC
        self.power_cycle()

    def power_cycle(self) -> None:
        """Power fails and comes back: registers have their saved values, the mode is configuration."""
        self.registers = [bytearray(128), bytearray(128)]
        for address, value in FACTORY.items():
            self.registers[1][address : address + 2] = struct.pack("<H", value)
        self.registers[1][0x6A:0x72], self.registers[1][0x74:0x7C] = self._product, self._serial_number
        self.registers[0][0x4C:0x4E] = struct.pack("<H", 0x5345)
        if self.velocity:
            self.registers[1][0x0C:0x0E] = struct.pack("<H", 0x4700)
        self._mode, self._window = CONFIGURATION, 0
        self._commands = self._answers = b""

    @property
    def sampling(self) -> bool:
        """Whether the sensor sends samples by itself."""
        return self._mode == SAMPLING and bool(self.registers[1][0x08] & 1)

    @property
    def count_step(self) -> int:
        """By how much the count rises from sample to sample."""
        return 1 if self.velocity else 4000 // RATES_HZ[self.registers[1][0x05]]

    def received(self, data: bytes) -> None:
        """Handle the commands in `data`, which may be split anywhere. What is no command is skipped."""
        self._commands += data
        while len(self._commands) >= 3:
            address, value, end = self._commands[:3]
            if end != 0x0D:
                self._commands = self._commands[1:]
                continue
            self._commands = self._commands[3:]
            if address & 0x80:
                self._write(address & 0x7F, value)
            else:
                self._answers += bytes([address, *self._read(address)]) + b"\r"

    def _write(self, address: int, value: int) -> None:
        if address == 0x7E:
            self._window = value & 1
        elif (self._window, address) == (0, 0x03):
            self._mode = {1: SAMPLING, 2: CONFIGURATION}.get(value & 3, self._mode)
        elif self._mode == CONFIGURATION:
            self.registers[self._window][address] = value

    def _read(self, address: int) -> tuple[int, int]:
        if (self._window, address) == (0, 0x02):
            return self._mode << 2, 0
        low, high = self.registers[self._window][address : address + 2]
        return high, low

    def text_due(self, t_s: float) -> bytes:
        """Frames that became due, with the contents that the registers select."""
        due = self._samples_due(t_s)
        first, self.next = self.next, max(self.next, due)
        text, self._answers = self._answers, b""
        if not self.sampling:
            return text
        samples = self._source(first, self.next - first).tolist()
        return text + b"".join(self.frame(first + i, axes) for i, axes in enumerate(samples))

    def frame(self, number: int, axes: list[int]) -> bytes:
        """One frame: 80, flags, temperature, x, y, z, count, checksum, 0D, each as far as BURST_CTRL selects it."""
        low, high = self.registers[1][0x0C:0x0E]
        body = struct.pack(">H", 0x8E00 | self.error) if high & 0x80 else b""
        if high & 0x40:
            body += struct.pack(">h" if self.velocity else ">i", self.temperature)
        width = 3 if self.velocity else 4
        body += b"".join(value.to_bytes(width, "big", signed=True) for value in axes)
        if low & 0x02:
            body += struct.pack(">H", number * self.count_step % 65536)
        if low & 0x01:
            body += struct.pack(">H", sum(struct.unpack(f">{len(body) // 2}H", body)) % 65536)
        return b"\x80" + body + b"\r"
