"""The site of the golden files from format 2 on: a sensor beside a tri-axial reference, both on serial ports.

A scenario serves the same devices on ports, so that a gateway can go on from the golden state file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config import Config, parse_config
from hw.block import DeviceInfo
from hw.virtual.building_motion import BuildingMotion, BuildingSpectrum
from hw.virtual.timebase import Bursts

Array = NDArray[np.float64]
SENSOR, REFERENCE = "imu", "ref"
SITE, GATEWAY = "golden", "gateway"
RATE_HZ = 100.0
WINDOW_S, GUARD_S = 6.0, 0.5
LEVEL_MPS2, NOISE_MPS2 = 0.6, {SENSOR: 0.03, REFERENCE: 0.001}
LONGEST_S = 600.0  # of the motion
BAND = BuildingSpectrum(0.5, 4.0, flat=1.0)  # slow, because the stamps of a busy machine may be off by milliseconds
LATE = Bursts(poll_s=0.018, mean_late_s=0.002, stall_probability=0.05, longest_stall_s=0.05)  # as on such a machine
U_LAG_WINDOW_S = 0.002
DECIMALS = 4
U_REFERENCE_PCT = 0.3
GRAVITY_MPS2 = np.array([0.0, 0.0, 9.80665])
SENSITIVITY = np.array([[1.008, 0.003, -0.004], [-0.002, 0.991, 0.005], [0.001, -0.003, 1.012]])
OFFSET_MPS2 = np.array([0.11, -0.07, 0.05])
# Errors of the references, by serial number, as a factor: known to U_REFERENCE_PCT.
REFERENCES: Mapping[str, float] = {"A": 1.003, "B": 0.998}


class World:
    """The motion and the two instruments; `seed` determines all."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        random = np.random.default_rng([seed, 0])
        self._motion = BuildingMotion(random, BAND, (0.0, LONGEST_S), LEVEL_MPS2, np.eye(3))

    def values(self, device: str, first: int, n: int, reference: str = "A") -> Array:
        """Indications (n, 3) of samples first .. first + n - 1, m/s2; `reference` is the serial number of the
        reference."""
        moved = self._motion.at(np.arange(first, first + n) / RATE_HZ)
        role = (SENSOR, REFERENCE).index(device)
        noise = [np.random.default_rng([self._seed, 1 + role, k]).standard_normal(3) for k in range(first, first + n)]
        if device == SENSOR:
            shown = (moved + GRAVITY_MPS2) @ SENSITIVITY.T + OFFSET_MPS2
        else:
            shown = REFERENCES[reference] * moved
        return np.round(shown + NOISE_MPS2[device] * np.reshape(noise, (n, 3)), DECIMALS)


def serial_number(device: str, reference: str = "A") -> str:
    """Of a device, as its label and the configuration say."""
    return "S1" if device == SENSOR else reference


def info(device: str) -> DeviceInfo:
    """What the driver tells when it opens a device of the golden recording."""
    return DeviceInfo(
        "serial-csv", "serial-csv", serial_number(device), "m/s2", 3, RATE_HZ,
        settings={"port": f"/dev/{device}", "baud_rate": "115200", "sequence": "True"},
    )  # fmt: skip


def config(ports: Mapping[str, Path], reference: str = "A", **keys: Any) -> dict[str, Any]:
    """The configuration of the site as it stands in a file; `keys` are further keys of the channel, by section."""
    devices = [
        {
            "name": device,
            "driver": "serial-csv",
            "options": {
                "port": str(ports[device]),
                "rate_hz": RATE_HZ,
                "axes": 3,
                "sequence": True,
                "unit": "m/s2",
                "serial_number": serial_number(device, reference),
            },
        }
        for device in (SENSOR, REFERENCE)
    ]
    channel: dict[str, Any] = {
        "sensor": SENSOR,
        "reference": REFERENCE,
        "rotation": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "rotation_gravity_mps2": GRAVITY_MPS2.tolist(),
        "window_s": WINDOW_S,
        "guard_s": GUARD_S,
        "prior": {"sensitivity": 1.0, "u_main_pct": 2.0, "u_transverse_pct": 1.0, "u_offset_mps2": 0.2},
        "certificate": {
            "u_sensitivity_pct": U_REFERENCE_PCT, "serial_number": reference, "calibrated": "2026-09-01"
        },
        "uncertainty": {"lag_window_s": U_LAG_WINDOW_S},
        "temperature": {"offset_order": 0},
    }  # fmt: skip
    for name, value in keys.items():
        channel[name] = {**channel.get(name, {}), **value} if isinstance(value, Mapping) else value
    return {
        "gateway": {"site": SITE, "name": GATEWAY},
        "devices": devices,
        "channels": [channel],
        "zenoh": {"enabled": False},
    }


def golden_config() -> Config:
    """The configuration of the golden recording."""
    return parse_config(config({SENSOR: Path("/dev/imu"), REFERENCE: Path("/dev/ref")}), "golden")
