"""Runs of one channel as they never should be: devices that come, go, change, jump, flood and lie, from a seed.

And one in which nothing happens, so that the sensor is calibrated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from agent.config import Config, parse_config
from agent.core.events import DeviceChange, Event, Gap, Tick
from calib.geometry import clamp
from hw.block import BlockFlags, DeviceInfo, SampleBlock

SECOND = 1_000_000_000
ORIGIN_NS = 5 * SECOND
EPOCH_NS = 1_790_000_000 * SECOND
RATE_HZ = 50.0
THETA_DEG, ALPHAS_DEG, STAY_S = 35.0, (0.0, 30.0, 120.0, 210.0), 2.0  # on the clamp


def config(reference: bool) -> Config:
    """A schedule that repeats each 8 s, four positions in it; with a reference on the clamp, without at rest."""
    forms: list[dict[str, Any]] = [{"gravity_mps2": g} for g in ((0, 0, 9.8), (9.8, 0, 0), (0, 9.8, 0), (0, -9.8, 0))]
    if reference:
        forms = [{"theta_deg": THETA_DEG, "alpha_deg": alpha} for alpha in ALPHAS_DEG]
    poses = [{"start_s": STAY_S * k, "stop_s": STAY_S * k + 1.6, **form} for k, form in enumerate(forms)]
    channel = {"sensor": "s", "prior": {}, "guard_s": 0.1, "late_horizon_s": 2, "silence_s": 2, "poses": poses}
    channel |= {"poses_repeat_s": 8.0} | ({"reference": "r"} if reference else {})
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    return parse_config({"devices": devices, "channels": [channel]}, "test")


@dataclass
class _Device:
    name: str
    axes: int
    swing_mps2: float
    nonsense: float = 0.02  # of the blocks
    next_index: int = 0
    flags: BlockFlags = BlockFlags.RESTART
    arrived_ns: int = ORIGIN_NS

    def block(self, now_ns: int, utc_ns: int, rng: np.random.Generator) -> SampleBlock:
        """All samples since the block before, read now in one to three bursts; now and then they are nonsense."""
        n = int(np.clip((now_ns - self.arrived_ns) * 1e-9 * RATE_HZ, 1, 100))
        count = np.unique([*rng.integers(1, n + 1, 2).tolist(), n]).astype(np.int32)
        early_ns = ((n - count) / RATE_HZ * 1e9).astype(np.int64)
        arrivals = np.maximum(now_ns - early_ns, self.arrived_ns + 1 + np.arange(len(count)))
        self.arrived_ns = int(arrivals[-1])
        t_s = self.arrived_ns * 1e-9 - (n - 1 - np.arange(n)) / RATE_HZ
        signal = self.swing_mps2 * np.sin(2 * np.pi * 2.0 * t_s)[:, None] * np.arange(1, self.axes + 1)
        values = signal + rng.normal(0.0, 0.02, (n, self.axes))
        if rng.random() < self.nonsense:
            values = rng.normal(0.0, 10.0 ** rng.integers(-3, 12), (n, self.axes))
        block = SampleBlock(
            self.name, "boot", utc_ns, self.next_index, RATE_HZ, arrivals, count, values, self.flags, None, None
        )
        self.next_index += n
        self.flags = BlockFlags.NONE
        return block


def happenings(seed: int, events: int, *, moving: bool) -> Iterator[Event]:
    """`events` events after a RunStart; the same for the same seed."""
    rng = np.random.default_rng(seed)
    swing_mps2 = 3.0 if moving else 0.0
    devices = {name: _Device(name, axes, swing_mps2) for name, axes in (("s", 3), ("r", 1), ("stranger", 3))}
    now_ns, utc_offset_ns = ORIGIN_NS, EPOCH_NS
    for device in devices.values():
        yield _opened(device, now_ns, now_ns + utc_offset_ns, "A")
    names = ["s", "r"] * 6 + ["stranger"]
    for _ in range(events):
        now_ns += int(rng.exponential(0.15) * 1e9) + (20 * SECOND if rng.random() < 0.003 else 0)
        utc_offset_ns += int(rng.normal(0, 3600) * 1e9) if rng.random() < 0.02 else 0
        device = devices[str(rng.choice(names))]
        kind = rng.random()
        if kind < 0.8:
            _mishap(device, rng)
            yield device.block(now_ns, now_ns + utc_offset_ns, rng)
        elif kind < 0.91:
            yield Tick(t_monotonic_ns=now_ns, t_utc_ns=now_ns + utc_offset_ns)
        elif kind < 0.92:
            yield _change(device, now_ns, now_ns + utc_offset_ns, rng)
        else:
            yield Gap(device=device.name, t_monotonic_ns=now_ns, dropped=3, unit="lines", reason="not readable")


def calm(blocks: int) -> Iterator[Event]:
    """So many blocks of half a second of a sensor without an error and of its reference, as `config` turns them."""
    rng = np.random.default_rng(0)
    sensor, reference = _Device("s", 3, 0.0, nonsense=0.0), _Device("r", 1, 3.0, nonsense=0.0)
    poses = [clamp(*np.radians((THETA_DEG, alpha))) for alpha in ALPHAS_DEG]
    for device in (sensor, reference):
        yield _opened(device, ORIGIN_NS, ORIGIN_NS + EPOCH_NS, "A")
    for k in range(1, blocks + 1):
        now_ns = ORIGIN_NS + k * SECOND // 2
        moved = reference.block(now_ns, now_ns + EPOCH_NS, rng)
        pose = poses[int((now_ns - 1 - ORIGIN_NS) / SECOND / STAY_S) % len(poses)]
        noise = sensor.block(now_ns, now_ns + EPOCH_NS, rng)
        yield moved
        yield replace(noise, indications=noise.indications + moved.indications @ pose.direction.T + pose.gravity_mps2)


def _mishap(device: _Device, rng: np.random.Generator) -> None:
    """Now and then samples are missing, known or not, or the device begins anew, maybe as another."""
    what = rng.random()
    if what < 0.01:
        device.next_index += int(rng.integers(1, 500))
        device.flags |= BlockFlags.GAP
    elif what < 0.015:
        device.flags |= BlockFlags.RESTART | BlockFlags.OVERRUN
    elif what < 0.02:
        device.flags |= BlockFlags.SATURATED
    elif what < 0.022:
        device.axes = 4 - device.axes
        device.flags |= BlockFlags.RESTART


def _change(device: _Device, now_ns: int, utc_ns: int, rng: np.random.Generator) -> DeviceChange:
    device.flags |= BlockFlags.RESTART
    if rng.random() < 0.5:
        return DeviceChange(device=device.name, state="lost", t_monotonic_ns=now_ns, t_utc_ns=utc_ns, message="gone")
    return _opened(device, now_ns, utc_ns, "B" if rng.random() < 0.2 else "A")


def _opened(device: _Device, now_ns: int, utc_ns: int, number: str) -> DeviceChange:
    axes: Any = device.axes
    info = DeviceInfo("serial-csv", "serial-csv", number, "m/s2", axes, RATE_HZ)
    return DeviceChange(
        device=device.name, state="open", t_monotonic_ns=now_ns, t_utc_ns=utc_ns, info_json=json.dumps(asdict(info))
    )
