"""Runs of one channel as they never should be: devices that come, go, change, jump, flood and lie, from a seed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agent.config import Config, parse_config
from agent.events import DeviceChange, Event, Gap, Tick
from hw.block import BlockFlags, DeviceInfo, SampleBlock

SECOND = 1_000_000_000
ORIGIN_NS = 5 * SECOND
EPOCH_NS = 1_790_000_000 * SECOND
RATE_HZ = 50.0


def config(reference: bool) -> Config:
    """A schedule that repeats each 6 s, three positions in it; with a reference on the clamp, without at rest."""
    forms: list[dict[str, Any]] = [{"gravity_mps2": g} for g in ((0, 0, 9.8), (9.8, 0, 0), (0, 9.8, 0))]
    if reference:
        forms = [{"theta_deg": 35, "alpha_deg": alpha} for alpha in (0, 30, 120)]
    poses = [{"start_s": 2 * k, "stop_s": 2 * k + 1.6, **form} for k, form in enumerate(forms)]
    channel = {"sensor": "s", "guard_s": 0.1, "late_horizon_s": 2, "silence_s": 2, "windows": 4, "poses": poses}
    channel |= {"poses_repeat_s": 6.0} | ({"reference": "r"} if reference else {})
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    return parse_config({"devices": devices, "channels": [channel]}, "test")


@dataclass
class _Device:
    name: str
    axes: int
    next_index: int = 0
    flags: BlockFlags = BlockFlags.RESTART
    arrived_ns: int = 0

    def block(self, now_ns: int, utc_ns: int, rng: np.random.Generator, n: int) -> SampleBlock:
        """`n` samples read now, in one to three bursts."""
        count = np.unique([*rng.integers(1, n + 1, 2).tolist(), n]).astype(np.int32)
        early_ns = ((n - count) / RATE_HZ * 1e9).astype(np.int64)
        arrivals = np.maximum(now_ns - early_ns, self.arrived_ns + 1 + np.arange(len(count)))
        self.arrived_ns = int(arrivals[-1])
        t_s = (self.next_index + np.arange(n)) / RATE_HZ
        signal = 3.0 * np.sin(2 * np.pi * 2.0 * t_s)[:, None] * np.arange(1, self.axes + 1)
        values = signal + rng.normal(0.0, 0.02, (n, self.axes))
        if rng.random() < 0.3:
            values = rng.normal(0.0, 10.0 ** rng.integers(-3, 12), (n, self.axes))
        block = SampleBlock(
            self.name, "boot", utc_ns, self.next_index, RATE_HZ, arrivals, count, values, self.flags, None, None
        )
        self.next_index += n
        self.flags = BlockFlags.NONE
        return block


def happenings(seed: int, events: int) -> Iterator[Event]:
    """`events` events after a RunStart; the same for the same seed."""
    rng = np.random.default_rng(seed)
    devices = {"s": _Device("s", 3), "r": _Device("r", 1), "stranger": _Device("stranger", 3)}
    now_ns, utc_offset_ns = ORIGIN_NS, EPOCH_NS
    names = ["s", "r"] * 6 + ["stranger"]
    for _ in range(events):
        now_ns += int(rng.exponential(0.15) * 1e9) + (20 * SECOND if rng.random() < 0.01 else 0)
        utc_offset_ns += int(rng.normal(0, 3600) * 1e9) if rng.random() < 0.02 else 0
        device = devices[str(rng.choice(names))]
        kind = rng.random()
        if kind < 0.7:
            _mishap(device, rng)
            yield device.block(now_ns, now_ns + utc_offset_ns, rng, int(rng.integers(1, 40)))
        elif kind < 0.9:
            yield Tick(t_monotonic_ns=now_ns, t_utc_ns=now_ns + utc_offset_ns)
        elif kind < 0.97:
            yield _change(device, now_ns, now_ns + utc_offset_ns, rng)
        else:
            yield Gap(device=device.name, t_monotonic_ns=now_ns, dropped=3, unit="lines", reason="not readable")


def _mishap(device: _Device, rng: np.random.Generator) -> None:
    """Now and then samples are missing, known or not, or the device begins anew, maybe as another."""
    what = rng.random()
    if what < 0.05:
        device.next_index += int(rng.integers(1, 500))
        device.flags |= BlockFlags.GAP
    elif what < 0.08:
        device.flags |= BlockFlags.RESTART | BlockFlags.OVERRUN
    elif what < 0.1:
        device.flags |= BlockFlags.SATURATED
    elif what < 0.105:
        device.axes = 4 - device.axes
        device.flags |= BlockFlags.RESTART


def _change(device: _Device, now_ns: int, utc_ns: int, rng: np.random.Generator) -> DeviceChange:
    device.flags |= BlockFlags.RESTART
    if rng.random() < 0.5:
        return DeviceChange(device=device.name, state="lost", t_monotonic_ns=now_ns, t_utc_ns=utc_ns, message="gone")
    number = str(rng.choice(["A", "A", "A", "B"]))
    axes: Any = device.axes
    info = DeviceInfo("serial-csv", "serial-csv", number, "m/s2", axes, RATE_HZ)
    return DeviceChange(
        device=device.name, state="open", t_monotonic_ns=now_ns, t_utc_ns=utc_ns, info_json=json.dumps(asdict(info))
    )
