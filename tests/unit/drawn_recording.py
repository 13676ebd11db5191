"""Recordings of a sensor beside a reference of any quantity, rate and corner, all faults drawn; as events and as files.

Motion is a sum of lines, so that velocity, displacement and what a first-order high-pass filter leaves are exact. The
bench turns the sensor on a clamp beside a uniaxial reference, the building has it beside a tri-axial one for good.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from agent.cli.calibrate import calibrate
from agent.config import parse_config
from agent.core.events import CalibrationUpdate, Result, StatusChange, WindowReport
from benchmarks.online.runner import Run, opened, tick, ticked
from hw.block import DeviceInfo, SampleBlock
from tests.clamp_windows import frame

G_MPS2, BURST, BLOCK_S = 9.80665, 5, 2.0
THETA_DEG, ALPHAS_DEG = 35.0, (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)
CALM = "the reference is calm here"  # its lines beat: now and then they cancel for a second
STILL: dict[str, Any] = {
    "sensitivity_pct": 0.0, "offset_mps2": 0.0, "offset_rate_mps2": 0.0, "offset_rate_walk_mps2": 0.0, "tilt_deg": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class Devices:
    """Rates, noise (of the reference in its own quantity), corners as they are, and the band of the motion."""

    rate_hz: float = 100.0
    reference_rate_hz: float = 100.0
    derivatives: int = 0
    reference_noise: float = 1e-3
    sensor_noise_mps2: float = 5e-3
    reference_corner_hz: float = 0.0
    sensor_corner_hz: float = 0.0
    band_hz: tuple[float, float] = (0.5, 8.0)
    level_mps2: float = 0.3
    lines: int = 40  # of the motion of each axis
    lost: tuple[int, ...] = ()  # samples of the reference, by number
    reference_filters: tuple[str, ...] = ()  # as its driver states them


class Motion:
    """`axes` independent random motions of some lines each."""

    def __init__(self, random: np.random.Generator, devices: Devices, axes: int) -> None:
        low, high = devices.band_hz
        edges = np.linspace(low, high, devices.lines + 1)
        self._hz = random.uniform(edges[:-1], edges[1:], (axes, devices.lines))
        drawn = random.normal(size=(2, axes, devices.lines))
        self._line = devices.level_mps2 * (drawn[0] + 1j * drawn[1]) / np.sqrt(devices.lines)

    def at(self, t: np.ndarray, *, derivatives: int = 0, corner_hz: float = 0.0) -> np.ndarray:
        """(n, axes) of what is differentiated so often to give the acceleration, after a filter of this corner, at
        equidistant times: exp(i w (t + s)) = exp(i w t) exp(i w s) takes far fewer exponentials than times."""
        passed = 1j * self._hz / (corner_hz + 1j * self._hz)
        lines = self._line * passed / (2j * np.pi * self._hz) ** derivatives
        size = round(np.sqrt(len(t)))
        turned, within = (np.exp(2j * np.pi * self._hz[..., None] * s) for s in (t[::size], t[:size] - t[0]))
        found = (lines[..., None] * turned).mT @ within
        return np.asarray(found.real.reshape(len(lines), -1).T[: len(t)])


class Recording:
    """Samples (n, 3) of the sensor and (N, 1 or 3) of the reference, and the truth `S`, `Q`."""

    def __init__(self, seed: int, devices: Devices, *, bench: bool, stand_s: float = 40.0) -> None:
        random = np.random.default_rng([seed, 11])
        self.devices, self.bench, self.stand_s = devices, bench, stand_s
        self.S = np.eye(3) + np.where(np.eye(3), 0.01, 0.005) * random.normal(size=(3, 3))
        self.Q = 0.1 * random.normal(size=3)
        self.duration_s = stand_s * len(ALPHAS_DEG)
        self._lag_s = 1e-3 * random.normal()
        motion = Motion(random, devices, 1 if bench else 3)
        scale = 1.0 + 1e-3 * random.normal(size=1 if bench else 3)
        self.sensor_s, self.reference_s = (
            np.arange(round(self.duration_s * hz)) / hz for hz in (devices.rate_hz, devices.reference_rate_hz)
        )
        felt_s = self.sensor_s - self._lag_s
        felt = motion.at(felt_s, corner_hz=devices.sensor_corner_hz)
        a = self._bench(random, felt) if bench else self._building(random, felt)
        self.V = a @ self.S.T + self.Q + devices.sensor_noise_mps2 * random.normal(size=a.shape)
        x = motion.at(self.reference_s, derivatives=devices.derivatives, corner_hz=devices.reference_corner_hz)
        self.x = x * scale + devices.reference_noise * random.normal(size=x.shape)

    def _bench(self, random: np.random.Generator, u: np.ndarray) -> np.ndarray:
        theta, common = np.deg2rad(THETA_DEG + 0.2 * random.normal()), 0.1 * random.normal()
        gravity, a = G_MPS2 + 0.03 * random.normal(), np.empty((len(u), 3))
        stand = np.minimum(self.sensor_s // self.stand_s, len(ALPHAS_DEG) - 1)
        for k, alpha_deg in enumerate(ALPHAS_DEG):
            d, e = frame(float(theta), float(np.deg2rad(alpha_deg + common + 0.2 * random.normal())))
            a[stand == k] = u[stand == k] * d + self._feels * gravity * e + 0.05 * random.normal(size=3)
        return a

    def _building(self, random: np.random.Generator, u: np.ndarray) -> np.ndarray:
        turn = np.deg2rad(0.2) * random.normal(size=3)
        gravity = np.append(np.deg2rad(0.2) * random.normal(size=2) * G_MPS2, G_MPS2 + 0.03 * random.normal())
        return u + np.cross(turn, u) + self._feels * gravity

    @property
    def _feels(self) -> float:
        return 0.0 if self.devices.sensor_corner_hz else 1.0

    def through_agent(self, *, reference_stated_from_s: float = 0.0, **sections: Any) -> list[Result]:
        """All results of a pipeline that is fed the recording. Before this time the reference's driver is silent."""
        d = self.devices
        axes = {"s": 3, "r": self.x.shape[1]}
        rates = {"s": d.rate_hz, "r": d.reference_rate_hz}
        channel: dict[str, Any] = {
            "sensor": "s", "reference": "r", "window_s": self.stand_s, "prior": {"sensitivity": 1.0}, "process": STILL,
            "coupling": "ac" if d.sensor_corner_hz else "dc", "temperature": {"offset_order": 0},
            "gate": {"least_determined": 1, "max_change_transverse_pct": 10.0, "max_change_main_pct": 10.0},
        }  # fmt: skip
        if self.bench:
            channel["poses"] = [
                {"start_s": k * self.stand_s, "stop_s": (k + 1) * self.stand_s, "theta_deg": THETA_DEG, "alpha_deg": a}
                for k, a in enumerate(ALPHAS_DEG)
            ]
        else:
            channel |= {
                "rotation": np.eye(3).ravel().tolist(), "rotation_gravity_mps2": [0.0, 0.0, self._feels * G_MPS2]
            }  # fmt: skip
        serial = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": rates[n]}} for n in "sr"]
        run = Run(parse_config({"devices": serial, "channels": [channel | sections]}, ""))
        infos = {n: DeviceInfo("serial-csv", "serial-csv", n, "m/s2", axes[n], rates[n]) for n in "rs"}
        stated = {"r": replace(infos["r"], filters=d.reference_filters)}
        blocks = [*self._blocks("s", self.V, d.rate_hz), *self._blocks("r", self.x, d.reference_rate_hz)]
        whole = [*ticked(sorted(blocks, key=lambda b: b.t_monotonic_ns)), tick(self.duration_s + 20.0)]
        first = sum(event.t_monotonic_ns <= reference_stated_from_s * 1e9 for event in whole)
        events = [*opened(infos), *whole[:first], *opened(stated), *whole[first:]]
        return [result for event in events for result in run.feed(event)]

    def _blocks(self, device: str, values: np.ndarray, rate_hz: float) -> list[SampleBlock]:
        size, found = round(BLOCK_S * rate_hz), []
        for first in range(0, len(values), size):
            part = values[first : first + size].copy()
            if device == "r":
                part[[k - first for k in self.devices.lost if first <= k < first + len(part)]] = np.nan
            count = np.arange(BURST, len(part) + 1, BURST, dtype=np.int32)
            arrivals = np.round((first + count) / rate_hz * 1e9).astype(np.int64)
            found.append(SampleBlock(
                device, "boot", 1_790_000_000_000_000_000 + int(arrivals[-1]), first, rate_hz, arrivals, count, part
            ))  # fmt: skip
        return found

    def through_files(self, directory: Path, *options: str) -> tuple[int, dict[str, Any]]:
        """Exit status and result of `fieldcal calibrate`."""
        columns = "ax,ay,az" if not self.bench else "avd"[self.devices.derivatives]
        keep = np.setdiff1d(np.arange(len(self.x)), self.devices.lost)
        reference = np.column_stack([self.reference_s, self.x])[keep]
        for name, header, rows in (
            ("sensor", "time_s,vx,vy,vz", np.column_stack([self.sensor_s, self.V])),
            ("reference", f"time_s,{columns}", reference),
        ):
            np.savetxt(directory / f"{name}.csv", rows, "%.9f", ",", header=header, comments="")
        told = ["--sensor", str(directory / "sensor.csv"), "--reference", str(directory / "reference.csv")]
        if self.bench:
            stands = [[k * self.stand_s, (k + 1) * self.stand_s, THETA_DEG, a] for k, a in enumerate(ALPHAS_DEG)]
            np.savetxt(
                directory / "poses.csv", stands, "%g", ",", header="start_s,stop_s,theta_deg,alpha_deg", comments=""
            )
            told += ["--poses", str(directory / "poses.csv")]
        told += ["--coupling", "ac" if self.devices.sensor_corner_hz else "dc", "--json", "-", *options]
        done = CliRunner().invoke(calibrate, told, standalone_mode=False)
        return int(done.return_value or 0), json.loads(done.stdout)

    def errors_over_u(self, sensitivity: Any, covariance: Any, determined: Any) -> np.ndarray:
        """(3, 3) errors of S over u, NaN where it was not determined."""
        u = np.sqrt(np.diag(np.array(covariance, dtype=float)))[:9].reshape(3, 3)
        found = np.array(sensitivity, dtype=float).reshape(3, 3)
        return np.where(np.array(determined)[..., :9].reshape(3, 3), (found - self.S) / u, np.nan)


def in_force(results: list[Result]) -> CalibrationUpdate:
    return [r for r in results if isinstance(r, CalibrationUpdate)][-1]


def reports(results: list[Result]) -> list[WindowReport]:
    return [r for r in results if isinstance(r, WindowReport)]


def statuses(results: list[Result]) -> list[str]:
    return [r.status for r in results if isinstance(r, StatusChange)]
