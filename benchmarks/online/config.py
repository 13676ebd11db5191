"""Configurations of the scenarios: what an operator would have written, with nominal values and their uncertainties."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.config import Config, parse_config
from hw.virtual.building import Building

LONGEST_SILENCE_S = 3600.0


def building_config(building: Building, **keys: Any) -> Config:
    """Sensor and reference of a building; rotation of the mount and gravity are nominal (identity, z up).

    `keys` are further keys of the channel, for example the section `prior`.
    """
    p = building.parameters
    devices = [
        {
            "name": name,
            "driver": "serial-csv",
            "options": {"port": name, "rate_hz": info.nominal_rate_hz, "axes": info.axes},
        }
        for name, info in building.infos().items()
    ]
    channel: dict[str, Any] = {
        "sensor": "sensor",
        "reference": "reference",
        "rotation": np.eye(3).ravel().tolist(),
        "rotation_gravity_mps2": [0.0, 0.0, 9.80665],
        "silence_s": LONGEST_SILENCE_S,
        "window_s": p.window_s,
        "every_s": p.every_s,
        "guard_s": p.lead_s if p.every_s else 0.5,
    }
    constant = {"prior": {}, "certificate": {"stability_pct": 0.0}}  # the virtual reference does not drift
    raw = {"devices": devices, "channels": [channel | constant | keys], "zenoh": {"enabled": False}}
    return parse_config(raw, "building")
