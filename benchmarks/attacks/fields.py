"""Changes of one message: a result, samples, the first event of a recording."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from agent.core.snapshot import pack, unpack
from agent.engine.known import known_engines


def other_result(message: Any, place: int) -> None:
    name = ("sxx", "szz", "qx", "u_sxx", "syx", "windows", "coverage_factor", "t_utc_ns", "sequence", "identity")[place]
    value = getattr(message, name)
    setattr(message, name, "ADXL355 1" if name == "identity" else value + 1 if isinstance(value, int) else value * 1.03)


def other_window(message: Any, place: int) -> None:
    if place % 2:
        message.used = not message.used
        message.reason = "" if message.used else "too quiet"
    else:
        name = ("points", "left_out", "start_s", "stop_s", "t_utc_ns")[place // 2]
        setattr(message, name, getattr(message, name) + 1)


def other_status(message: Any, place: int) -> None:
    texts = "VALID", "INVALID", "DRIFT", "", "valid", "x" * 9999, "COLLECTING", "\0", "\x1b[2J", "UNCALIBRATED"
    message.status = texts[place]
    message.reason = "as measured"


def other_samples(message: Any, place: int) -> None:
    """One sample, an arrival, an index, a rate, flags, a temperature: no result need change by it."""

    def bump(name: str, width: int) -> None:
        content = bytearray(getattr(message, name))
        content[len(content) // 2 // width * width] ^= 1
        setattr(message, name, bytes(content))

    match place:
        case 0 | 1:
            bump("differences" if message.differences else "x", 8)
        case 2:
            bump("first_values" if message.first_values else "y", 8)
        case 3:
            bump("burst_intervals_ns" if message.burst_intervals_ns else "burst_t_monotonic_ns", 4)
        case 4:
            message.first_index += 1
        case 5:
            message.nominal_rate_hz *= 1.0001
        case 6:
            message.flags ^= 1
        case 7:
            message.temperature_degc = 21.5
        case 8:
            message.t_utc_ns += 1
        case _:
            message.device = "r"


BIG = (1 << 31) - 1


def hostile_samples(message: Any, place: int) -> None:
    """Sizes that explode, orders and lengths that do not agree, in the packed encoding."""
    for name in ("x", "y", "z", "x_counts", "y_counts", "z_counts"):
        message.ClearField(name)
    message.axes, message.decimal, message.order = 3, place % 2 == 1, 1
    n = 50
    match place:
        case 0:  # many samples of no bytes
            message.burst_sizes, message.first_values, message.differences = b"\xff" * 4_000_000, bytes(12), b""
        case 1:
            message.ClearField("burst_sizes")
            message.burst_count = struct.pack("<i", BIG)
            message.first_values, message.differences = bytes(12), bytes(3)
        case 2:
            message.order = 0xFFFFFFFF
            message.first_values, message.differences = bytes(12), bytes(300)
        case 3:
            message.decimal_places = 0xFFFFFFFF
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
        case 4:  # sums that wrap around
            message.order, message.burst_sizes = 2, bytes([n])
            message.first_values, message.differences = b"\xff\xff\xff\x7f" * 6, b"\x7f" * (3 * (n - 2) * 4)
        case 5:
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
            message.negative_zeros = struct.pack("<i", -1) * 1_000_000
        case 6:
            message.axes = 0xFFFFFFFF
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
        case 7:
            message.burst_sizes, message.first_values, message.differences = b"\1" * n, bytes(12), bytes(1 << 27)
        case 8:
            message.ClearField("burst_sizes")
            message.burst_count = struct.pack("<50i", *range(50, 0, -1))
            message.first_values, message.differences = bytes(12), bytes(3 * (n - 1))
        case _:
            message.burst_sizes, message.first_values, message.differences = bytes(n), bytes(12), bytes(1 << 26)


def other_snapshot(message: Any, place: int) -> bool | None:
    """Another state before the first event, S and Q or what is in force 5 % off."""
    if message.WhichOneof("event") != "run_start":
        return False
    state = unpack(message.run_start.snapshot)
    changed = scaled(state, 1.0 + 0.001 * 3**place)
    message.run_start.snapshot = pack(changed) if place < 8 else (b"", b"\xc1" * 50)[place - 8]
    return None


def scaled(value: Any, factor: float) -> Any:
    """The same with every vector of 12 or more numbers in it multiplied, also in the states of devices in it."""
    if isinstance(value, bytes):
        return pack(scaled(unpack(value), factor))
    if isinstance(value, dict):
        return {key: scaled(each, factor) for key, each in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == float and value.ndim == 1 and value.size >= 12:
        return value * factor
    return value


def engine_names() -> tuple[str, ...]:
    known = [f"{engine.number}-{engine.id}" for engine in known_engines()]
    return (
        known[-1], "11-0123456789abcdef", "", "99", "11", "12-../../etc/passwd", "x" * 100_000,
        "\x1b[2J", known[0], "11-0123456789ABCDEF",
    )  # fmt: skip


def other_engine(message: Any, place: int) -> bool | None:
    if message.WhichOneof("event") != "run_start":
        return False
    message.run_start.engine = engine_names()[place]
    return None


def other_run(message: Any, place: int) -> bool | None:
    """Another run, gateway, boot, number, configuration or kernel in the first event."""
    start = message.run_start
    if message.WhichOneof("event") != "run_start":
        return False
    match place:
        case 0:
            start.run_id = "run-9"
        case 1:
            start.gateway = "other"
        case 2:
            start.continuation = not start.continuation
        case 3:
            start.file_sequence += 1
        case 4:
            start.config_json = start.config_json.replace("9.80665", "9.80655")
        case 5:
            start.fingerprint["numpy"] = "1.0"
        case 6:
            start.t_utc_ns += 10**15
        case 7:
            start.boot_id = "x"
        case 8:
            start.config_json = "{"
        case _:
            start.engine_sha256 = "0" * 64
    return None
