"""Who a device is, and what its data sheet says, out of what it told when it was opened."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from agent.config.knowledge import Certificate

# Ports and speeds name the way to a device, not the device: they may change without the calibration losing its sense.
WAYS = frozenset({"port", "baud_rate", "bus"})


def identity_of(info_json: str) -> str:
    """Who a device is and how it is set: a calibration holds for this and nothing else."""
    info = json.loads(info_json)
    settings = {k: v for k, v in info["settings"].items() if k not in WAYS}
    held = [info["driver"], info["kind"], info["serial_number"], info["unit"], info["axes"], sorted(settings.items())]
    digest = hashlib.sha256(json.dumps(held).encode()).hexdigest()[:12]
    return " ".join(part for part in (info["kind"], info["serial_number"], digest) if part)


def nominal_of(info: Mapping[str, Any]) -> float | None:
    """What the device's data sheet says of its sensitivity; one that tells m/s2 has 1."""
    nominal = info["nominal_sensitivity"]
    return 1.0 if nominal is None and info["unit"] == "m/s2" else nominal


def not_certified(info_json: str, certificate: Certificate) -> str:
    """Why the certificate is not this reference's, "" where it may be: a device that tells no number says nothing."""
    told, stated = json.loads(info_json)["serial_number"], certificate.serial_number
    if not told or not stated or told == stated:
        return ""
    return f"the certificate is of serial number {stated}, the reference is {told}"
