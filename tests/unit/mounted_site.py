"""A pipeline with a sensor beside a tri-axial AC-coupled reference at a fixed mount, fed second by second."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from agent.config import Config, parse_config
from agent.core.events import CalibrationUpdate, Command, DeviceChange, Result, StatusChange, Tick, WindowReport
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.delivery.history import StoredResult
from hw.block import BlockFlags, DeviceInfo, SampleBlock
from tests.building_windows import GRAVITY
from tests.clamp_windows import Q_TRUE, S_TRUE

SECOND = 1_000_000_000
EPOCH_NS = 1_790_000_000 * SECOND
RATE_HZ, BURST, BLOCK_S, WINDOW_S = 50, 10, 4, 20
DIRECTIONS = ((0.7, 2.1), (1.1, 3.7), (1.6, 5.3))  # Hz, two tones each


def site_config(**more: Any) -> Config:
    """One channel; `more` are sections of it."""
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in "sr"]
    channel: dict[str, Any] = {
        "sensor": "s",
        "reference": "r",
        "rotation": np.eye(3).ravel().tolist(),
        "rotation_gravity_mps2": GRAVITY.tolist(),
        "prior": {"sensitivity": 1.0},
        "window_s": WINDOW_S,
    }
    return parse_config({"devices": devices, "channels": [channel | more]}, "")


class Site:
    """Time goes on with `play` and `wait`; all results are kept."""

    def __init__(
        self, config: Config, kept: dict[str, bytes] | None = None, *, day: float = 0.0, last: int = 0
    ) -> None:
        """`day` is when the run begins, `kept` what runs before left."""
        self.pipeline = Pipeline.begin(config, f"run {day}", 0, last, {"s": kept or {}})
        self._epoch_ns = EPOCH_NS + round(day * 86400 * SECOND)
        self._random = np.random.default_rng(round(day) + 1)
        self._fresh: set[str] = set()
        self.t_s = 0
        self.results: list[Result] = []
        self.memories: dict[str, Memory] = {}
        self.spoiled: dict[str, float] = {}  # by device: all that it shows is as many times too large
        self.late_s: dict[str, float] = {}  # by device: the motion that it shows is as many seconds old

    def step(self, event: Any) -> list[Result]:
        outputs = self.pipeline.step(event)
        found = [item for item in outputs if isinstance(item, Result)]
        self.memories |= {memory.identity: memory for memory in self.pipeline.memories(outputs)}
        self.results += found
        return found

    def open(self, device: str, serial_number: str = "A") -> list[Result]:
        info = DeviceInfo("serial-csv", "serial-csv", serial_number, "m/s2", 3, float(RATE_HZ))
        self._fresh.add(device)
        return self.step(
            DeviceChange(
                device=device, state="open", t_monotonic_ns=self._now_ns, t_utc_ns=self._utc_ns,
                info_json=json.dumps(asdict(info)),
            )
        )  # fmt: skip

    def lose(self, device: str) -> list[Result]:
        return self.step(
            DeviceChange(
                device=device, state="lost", t_monotonic_ns=self._now_ns, t_utc_ns=self._utc_ns, message="unplugged"
            )
        )

    def command(self, verb: str, calibration: CalibrationUpdate | None = None, **arguments: Any) -> list[Result]:
        return self.step(
            Command(
                sensor="s", verb=verb, t_monotonic_ns=self._now_ns, t_utc_ns=self._utc_ns,  # type: ignore[arg-type]
                arguments_json=json.dumps(arguments), key_id="k",
                calibration_json=_json(calibration),
            )
        )  # fmt: skip

    def play(self, windows: int, *, S: np.ndarray = S_TRUE, devices: str = "sr") -> list[Result]:
        """Both devices for as long as so many windows take."""
        found: list[Result] = []
        for _ in range(windows * WINDOW_S // BLOCK_S):
            n = BLOCK_S * RATE_HZ
            index = self.t_s * RATE_HZ + np.arange(n)
            t = index / RATE_HZ
            a, u = (_motion(t - self.late_s.get(device, 0.0)) for device in "sr")
            V = (a + GRAVITY) @ S.T + Q_TRUE + 0.005 * self._random.normal(size=a.shape)
            self.t_s += BLOCK_S
            for device, values in (("s", V), ("r", u)):
                if device in devices:
                    found += self.step(self._block(device, int(index[0]), values * self.spoiled.get(device, 1.0)))
        return found

    def wait(self, seconds: int) -> list[Result]:
        """Nothing comes but the clock's ticks."""
        found: list[Result] = []
        for _ in range(seconds):
            self.t_s += 1
            found += self.step(Tick(t_monotonic_ns=self._now_ns, t_utc_ns=self._utc_ns))
        return found

    def kept(self) -> dict[str, bytes]:
        """What the store has of every device when the run is killed now."""
        return {identity: memory.state for identity, memory in self.memories.items()}

    @property
    def _now_ns(self) -> int:
        return self.t_s * SECOND + SECOND // 100

    @property
    def _utc_ns(self) -> int:
        return self._epoch_ns + self._now_ns

    def _block(self, device: str, first: int, values: np.ndarray) -> SampleBlock:
        ends = first + np.arange(BURST, len(values) + 1, BURST)
        arrivals = (ends * SECOND) // RATE_HZ
        flags = BlockFlags.RESTART if device in self._fresh else BlockFlags(0)
        self._fresh.discard(device)
        return SampleBlock(
            device, "boot", self._epoch_ns + int(arrivals[-1]), first, float(RATE_HZ), arrivals.astype(np.int64),
            np.arange(BURST, len(values) + 1, BURST, dtype=np.int32), np.ascontiguousarray(values), flags=flags,
        )  # fmt: skip


def _motion(t: np.ndarray) -> np.ndarray:
    return np.column_stack([sum(0.2 * np.sin(2 * np.pi * f * t + f) for f in tones) for tones in DIRECTIONS])


def _json(calibration: CalibrationUpdate | None) -> str:
    """As the store has it."""
    return StoredResult.of(calibration, recorded=False, recording="").payload.decode() if calibration else ""


def begun(config: Config, **more: Any) -> Site:
    """A site whose devices are open."""
    site = Site(config, **more)
    site.open("r")
    site.open("s")
    return site


def windows(results: list[Result]) -> list[WindowReport]:
    return [r for r in results if isinstance(r, WindowReport)]


def updates(results: list[Result]) -> list[CalibrationUpdate]:
    return [r for r in results if isinstance(r, CalibrationUpdate)]


def said(results: list[Result]) -> list[tuple[str, str]]:
    """(status, reason) of every status change."""
    return [(r.status, r.reason) for r in results if isinstance(r, StatusChange)]
