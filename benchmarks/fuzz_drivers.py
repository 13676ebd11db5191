"""Random and mutated byte streams through every parser of the drivers: no exception may occur, no memory may grow.

`python -m benchmarks.fuzz_drivers [STREAMS [SEED]]`: 10^6 streams by default, divided equally among the parsers.
"""

from __future__ import annotations

import contextlib
import gc
import os
import random
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; must be set before numpy is loaded

import numpy as np

from agent.recording.messages import MessageError, decode
from agent.recording.raw_block import encode_block
from hw import (
    adxl355_registers,
    icm42688_registers,
    iio_scan,
    lis3dh_registers,
    lsm6dso_registers,
    miniseed,
    shake_datagram,
)
from hw.block import SampleBlock
from hw.cutting import Cutter
from hw.epson import EpsonOptions, EpsonStream
from hw.fifo import plain_samples
from hw.line_columns import columns_of
from hw.line_stream import LineStream
from hw.mip import MipStream
from hw.mqtt_payload import Json, PayloadError, Sparkplug
from hw.sensor import ConfigurationError
from hw.serial_binary import BinaryStream, SerialBinaryOptions
from hw.serial_sensor import Stream
from hw.sound_card import read_plate
from hw.sparkplug_pb2 import Payload
from hw.virtual import (
    adxl355_twin,
    epson_twin,
    lsm6dso_twin,
    mip_twin,
    seedlink_twin,
    shake_twin,
    witmotion_twin,
)
from hw.witmotion import WitStream

STREAMS = 1_000_000
LONGEST = 120  # bytes of a random stream
REOPEN = 50  # a port is opened again after this many streams
WARM_UP = 2_000  # streams after which the caches are full and memory is measured
LINE = columns_of(3, sequence=True)
COUNTS = np.arange(30, dtype=np.int32).reshape(10, 3)

Parse = Callable[[bytes, int], object]
"""Takes the bytes and the number of the stream."""


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one parser. `grown_bytes`: memory allocated at the end and not at the end of the warm-up."""

    parser: str
    streams: int
    cpu_s: float
    grown_bytes: int


def parsers() -> dict[str, tuple[bytes, Parse]]:
    """By name: a good stream to mutate, and the function that parses a stream."""
    binary = SerialBinaryOptions.model_validate(
        {
            "port": "p", "rate_hz": 100.0, "start": "aa55", "length": 12, "checksum": "sum8",
            "indications": [{"at": 3, "type": "f32"}], "sequence": {"at": 2, "type": "u8"},
            "temperature": {"at": 7, "type": "f32"},
        }
    )  # fmt: skip
    epson = EpsonOptions.model_validate({"port": "p"})
    velocity = EpsonOptions.model_validate({"port": "p", "unit": "m/s", "rate_hz": 3000.0})
    frames = b"".join(_closed(bytes([0xAA, 0x55, i, *range(8)])) for i in range(8))
    wit = b"".join(
        witmotion_twin.frame(0x50, 0, 0, 0, 5 * i) + witmotion_twin.frame(0x51, 1, 2, 3, 4) for i in range(5)
    )
    lines = b"".join(b"%d,1.5,2.5,-3\n" % i for i in range(8))
    block = SampleBlock("d", "b", 1, 0, 1000.0, np.array([1, 2]), np.array([5, 10], np.int32), COUNTS)
    return {
        "adxl355": (adxl355_twin.encode(COUNTS), _adxl355),
        "lsm6dso": (lsm6dso_twin.words(2, 0, COUNTS), _lsm6dso),
        "adxl345, mpu6050, icm20948": (bytes(60), lambda data, i: plain_samples(_whole(data, 6), "<>"[i % 2])),
        "icm42688": (b"@" + bytes(7) + b"@" * 16, lambda data, i: icm42688_registers.samples(_whole(data, 8))),  # noqa: ARG005
        "lis3dh": (bytes(60), lambda data, i: lis3dh_registers.samples(_whole(data, 6))),  # noqa: ARG005
        "witmotion": (wit, _fed(WitStream(Cutter("w", 200.0), 200.0))),
        "epson": (_epson(b"A352AD10"), _fed(EpsonStream(Cutter("e", 200.0), epson))),
        "epson, velocity": (
            _epson(b"A342VD10"),
            _fed(EpsonStream(Cutter("v", 3000.0), velocity)),
        ),
        "mip": (_mip(), _fed(MipStream(Cutter("m", 100.0), 100.0))),
        "serial-binary": (frames, _fed(BinaryStream(Cutter("b", 100.0), binary))),
        "serial-csv": (lines, _fed(LineStream(Cutter("l", 100.0), LINE, longest_gap=1000.0))),
        "seedlink": (seedlink_twin.record("AM.R1.00.ENZ", 0, 100, COUNTS[:, 0]), _miniseed),
        "shake-udp": (shake_twin.datagram("ENZ", 1_582_315_130_292_000_000, COUNTS[:, 0]), _shake),
        "mqtt, sparkplug-b": (_sparkplug(), _payload(Sparkplug(("x",), "n"))),
        "mqtt, json": (b'{"x": [1, 2.5], "n": 7, "timestamp": 1e12}', _payload(Json(("x",), "n"))),
        "iio": (b"le:s20/32>>12", _iio),
        "sound-card": (
            b"333D01 1012345" + b"60540" * 2 + b"210517",
            lambda data, i: read_plate(_text(data), i % 2 + 1),
        ),
        "replay": (encode_block(7, block), _replay),
    }


def _epson(product: bytes) -> bytes:
    twin = epson_twin.EpsonTwin(lambda _, n: np.zeros((n, 3), np.int32), lambda _: 0, product=product)
    twin.registers[1][0x0C:0x0E] = b"\x02\x07" if twin.velocity else b"\x03\xc7"
    return b"".join(twin.frame(k, [k, -k, 8]) for k in range(6))


def _mip() -> bytes:
    twin = mip_twin.MipTwin(lambda _, n: np.zeros((n, 3)), lambda _: 0, 100.0)
    twin.format = [(0x12, 10), (0x04, 10)]
    return b"".join(twin.sample(k, [0.5, -1.0, k / 8]) for k in range(3))


def fuzz(streams: int, seed: int) -> list[Row]:
    """Run `streams` streams through each parser; an exception that a parser may not raise is passed on."""
    rows = []
    for name, (good, parse) in parsers().items():
        draw = random.Random(f"{seed} {name}")
        for i in range(min(WARM_UP, streams)):
            parse(_mutated(good, draw), i)
        gc.collect()
        tracemalloc.start()
        before, began_s = tracemalloc.get_traced_memory()[0], time.process_time()
        for i in range(streams):
            parse(draw.randbytes(draw.randrange(LONGEST)) if i % 4 == 0 else _mutated(good, draw), i)
        cpu_s = time.process_time() - began_s
        gc.collect()
        rows.append(Row(name, streams, cpu_s, tracemalloc.get_traced_memory()[0] - before))
        tracemalloc.stop()
    return rows


def _mutated(good: bytes, draw: random.Random) -> bytes:
    """Change `good`: up to three bits, or bytes removed, inserted or changed."""
    data = bytearray(good)
    for _ in range(draw.randrange(4)):
        at = draw.randrange(len(data) + 1)
        kind = draw.randrange(4)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[at : at + draw.randrange(9)]
        elif kind == 2:
            data[at:at] = draw.randbytes(draw.randrange(9))
        elif data:
            data[at % len(data)] = draw.randrange(256)
    return bytes(data)


def _fed(stream: Stream) -> Parse:
    def parse(data: bytes, i: int) -> None:
        if i % REOPEN == 0:
            stream.begin()
        if data:
            stream.feed(data, i + 1, i + 1)
        stream.blocks()
        stream.take_drops()

    return parse


def _adxl355(data: bytes, i: int) -> None:  # noqa: ARG001 - all streams are treated alike
    adxl355_registers.triples(adxl355_registers.without_empty(_whole(data, 3)))


def _lsm6dso(data: bytes, i: int) -> None:
    lsm6dso_registers.tagged_samples(_whole(data, lsm6dso_registers.WORD_BYTES), None if i % 5 == 0 else i % 4)


def _iio(data: bytes, i: int) -> None:  # noqa: ARG001 - all streams are treated alike
    with contextlib.suppress(ConfigurationError):  # the error for a file that the kernel cannot have written
        element = iio_scan.Element.parse(0, _text(data))
        scan = iio_scan.layout({"timestamp": element})
        element.value(np.frombuffer(_whole(data, scan.itemsize), scan)["timestamp"])


def _miniseed(data: bytes, i: int) -> None:
    whole = bytearray((data + bytes(miniseed.RECORD_BYTES))[: miniseed.RECORD_BYTES])
    whole[52] = (3, 4, 5, 10, 11)[i % 5]  # the encoding
    with contextlib.suppress(miniseed.RecordError):
        miniseed.decode(bytes(whole))


def _shake(data: bytes, i: int) -> None:  # noqa: ARG001 - all streams are treated alike
    with contextlib.suppress(shake_datagram.DatagramError):
        shake_datagram.decode(data)


def _payload(decoder: Sparkplug | Json) -> Parse:
    def parse(data: bytes, i: int) -> None:
        with contextlib.suppress(PayloadError):
            if i % 3 == 0 and isinstance(decoder, Sparkplug):
                decoder.learn(data)
            decoder(data)

    return parse


def _sparkplug() -> bytes:
    payload = Payload(timestamp=1)
    payload.metrics.add(name="x", alias=3, datatype=31, bytes_value=bytes(24))
    payload.metrics.add(name="n", datatype=8, long_value=7)
    return bytes(payload.SerializeToString())


def _replay(data: bytes, i: int) -> None:  # noqa: ARG001 - all streams are treated alike
    with contextlib.suppress(MessageError):  # the error for a damaged recording
        decode("fieldcal.v1.RawBlock", data)


def _closed(body: bytes) -> bytes:
    return body + bytes([sum(body) & 0xFF])


def _whole(data: bytes, size: int) -> bytes:
    return data[: len(data) // size * size]


def _text(data: bytes) -> str:
    return data.decode("ascii", errors="replace")


def main() -> None:
    """Print one row per parser, and the sum."""
    total = int(sys.argv[1]) if len(sys.argv) > 1 else STREAMS
    rows = fuzz(-(-total // len(parsers())), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    for row in rows:
        print(f"{row.parser}: {row.streams} streams, {row.cpu_s:.0f} s, memory {row.grown_bytes:+d} bytes")
    print(f"{sum(row.streams for row in rows)} streams, no exception, {sum(row.grown_bytes for row in rows):+d} bytes")


if __name__ == "__main__":
    main()
