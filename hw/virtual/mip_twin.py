"""A MicroStrain sensor at the level of its bytes, for `PtyDevice`."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

OLD = [0x0101, 0x0102, 0x0103, 0x0104, 0x0106, 0x0C06, 0x0C08, 0x0C11, 0x0C31, 0x0C37, 0x0C50,
       0x8004, 0x8005, 0x8006, 0x8012, 0x8205]  # fmt: skip
NEW = [0x0101, 0x0102, 0x0103, 0x0104, 0x0106, 0x0107, 0x0C0E, 0x0C0F, 0x0C11, 0x0C31, 0x0C37, 0x0C52, 0x0C53, 0x0C54,
       0x8004, 0x8005, 0x8012, 0xA0D5]  # fmt: skip
MORE = [0x80D3, 0x80D5]


def packet(descriptor_set: int, *fields: tuple[int, bytes]) -> bytes:
    """One packet: 75 65, set, length, fields, two sums."""
    payload = b"".join(bytes([len(data) + 2, descriptor]) + data for descriptor, data in fields)
    body = bytes([0x75, 0x65, descriptor_set, len(payload)]) + payload
    return body + bytes([sum(body) % 256, sum(itertools.accumulate(body)) % 256])


class MipTwin:
    """A sensor that takes one sample every 1 / `rate_hz`; `text_due` and `received` are arguments of `PtyDevice`.

    `source(first, n)` returns (n, 3) accelerations in g, `samples_due(t_s)` the number of samples that exist at `t_s`.
    `new`: it has the commands of the CV7 and later. Between its own packets it sends others, as real sensors do.
    """

    def __init__(
        self,
        source: Callable[[int, int], NDArray[np.float64]],
        samples_due: Callable[[float], int],
        rate_hz: float,
        *,
        new: bool = False,
        base_hz: int = 1000,
    ) -> None:
        self._source = source
        self._samples_due = samples_due
        self._rate_hz = rate_hz
        self._base_hz = base_hz
        self.new = new
        self._other = 0xA0 if new else 0x82  # a stream beside that of the sensors
        self.next = 0
        self.power_cycle()

    def power_cycle(self) -> None:
        """Power fails and comes back: settings have their saved values, the clock starts again, all streams are on."""
        self.format = [(0x05, 10), (0x06, 20)]
        self.filter = (True, True)  # on, at a frequency of its own
        self.bias, self.to_vehicle = bytes([9] * 12), bytes([8] * 12)
        self.streams = {0x80, self._other}
        self.sending = True
        self._commands = self._answers = b""
        self._zero = self.next

    def received(self, data: bytes) -> None:
        """Handle the commands in `data`, which may be split anywhere."""
        self._commands += data
        while (at := self._commands.find(b"\x75\x65")) >= 0:
            self._commands = self._commands[at:]
            if len(self._commands) < 4 or len(self._commands) < (end := self._commands[3] + 6):
                return
            whole, self._commands = self._commands[:end], self._commands[end:]
            if whole == packet(whole[2], (whole[5], whole[6:-2])):
                code, *reply = self._do(whole[2], whole[5], whole[6:-2])
                acknowledged = (0xF1, bytes([whole[5], code]))
                self._answers += packet(whole[2], acknowledged, *reply)

    def _do(self, descriptor_set: int, command: int, data: bytes) -> tuple:  # type: ignore[type-arg]
        known = NEW + MORE if self.new else OLD
        if descriptor_set << 8 | command not in known:
            return (1,)
        if descriptor_set == 0x01:
            return self._base(command)
        if command in (0x06, 0x0E):
            rate = struct.pack(">H", self._base_hz)
            return (0, (0x8E, data + rate) if self.new else (0x83, rate))
        if command == 0x11:
            return self._stream(data)
        if command in (0x52, 0x53):
            ranges = b"".join(struct.pack(">Bf", setting, g) for setting, g in ((1, 2.0), (2, 8.0), (3, 40.0)))
            return (0, (0xD2, b"\x01\x02") if command == 0x52 else (0xD3, b"\x01\x03" + ranges))
        if data[0] == 2:
            return (0, self._read(command))
        return self._write(command, data[1:])

    def _base(self, command: int) -> tuple:  # type: ignore[type-arg]
        if command in (0x02, 0x06):
            self.sending = command == 0x06
        texts = ("3DM-CV7-AHRS", "6286-9940", "6286.123456", "", "") if self.new else (
            "3DM-GX5-25", "6253-4220", "6253.54321", "", "8g, 300d/s")  # fmt: skip
        info = struct.pack(">H", 1234) + b"".join(text.rjust(16).encode() for text in texts)
        lists = struct.pack(f">{len(NEW)}H", *NEW) if self.new else struct.pack(f">{len(OLD)}H", *OLD)
        replies = {0x03: (0x81, info), 0x04: (0x82, lists), 0x07: (0x86, struct.pack(">2H", *MORE))}
        return (0, replies[command]) if command in replies else (0,)

    def _stream(self, data: bytes) -> tuple:  # type: ignore[type-arg]
        data_set = data[1] if self.new else {1: 0x80, 2: 0x81, 3: 0x82}.get(data[1])
        if data_set is None:
            return (3,)
        self.streams = self.streams | {data_set} if data[2] else self.streams - {data_set}
        return (0,)

    def _read(self, command: int) -> tuple[int, bytes]:
        which = b"\x80" if self.new else b""
        if command in (0x08, 0x0F):
            held = b"".join(struct.pack(">BH", *entry) for entry in self.format)
            return (0x8F if self.new else 0x80), which + bytes([len(self.format)]) + held
        frequency = struct.pack(">f", self._rate_hz / 2) if self.new else struct.pack(">HB", 0, 0)
        return (0xD4 if self.new else 0x8B), which + b"\x04" + bytes(self.filter) + frequency

    def _write(self, command: int, data: bytes) -> tuple[int]:
        data = data[1:] if self.new and command in (0x0F, 0x54) else data
        if command in (0x08, 0x0F):
            self.format = [struct.unpack(">BH", data[at : at + 3]) for at in range(1, 1 + 3 * data[0], 3)]
        elif command in (0x50, 0x54):
            self.filter = bool(data[1]), bool(data[2])
        elif command == 0x37:
            self.bias = data
        else:
            self.to_vehicle = data
        return (0,)

    def text_due(self, t_s: float) -> bytes:
        """Packets that became due, with the fields that were asked for."""
        due = self._samples_due(t_s)
        first, self.next = self.next, max(self.next, due)
        text, self._answers = self._answers, b""
        if not self.sending:
            return text
        rows = self._source(first, self.next - first).tolist()
        return text + b"".join(self.sample(first + i, row) for i, row in enumerate(rows))

    def sample(self, number: int, row: list[float]) -> bytes:
        """The packets of one sample."""
        since_s = (number - self._zero) / self._rate_hz
        contents = {
            0x04: struct.pack(">3f", *row),
            0x05: struct.pack(">3f", 0.1, 0.2, 0.3),
            0x06: struct.pack(">3f", 0.4, 0.5, 0.6),
            0x12: struct.pack(">dHH", (604_799.5 + since_s) % 604_800.0, 0, 0),
            0xD5: struct.pack(">Q", round((7.0 + since_s) * 1e9)),
        }
        text = b""
        if 0x80 in self.streams:
            text += packet(0x80, *((descriptor, contents[descriptor]) for descriptor, _ in self.format))
        if self._other in self.streams:
            text += packet(self._other, (0x05, bytes(14)))
        return text
