"""Identity of a device and its data sheet's sensitivity, from the information that its driver read at opening."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Set
from typing import Any

from agent.config.knowledge import Certificate

# Ports and speeds belong to the connection, not to the device: the calibration stays valid when they change.
WAYS = frozenset({"port", "baud_rate", "bus"})


def identity_of(info_json: str) -> str:
    """Identity of a device with its settings. A calibration is valid for this identity only."""
    return _identity(json.loads(info_json), WAYS)


def device_of(info: Mapping[str, Any]) -> str:
    """The same without the settings that change nothing but the rate and the filters that the driver states: a
    calibration stays valid but for what the filters change."""
    named = info.get("filter_settings", ())
    return _identity(info, WAYS.union(name for name in named if isinstance(name, str)))


def _identity(info: Mapping[str, Any], but: Set[str]) -> str:
    settings = {k: v for k, v in info["settings"].items() if k not in but}
    held = [info["driver"], info["kind"], info["serial_number"], info["unit"], info["axes"], sorted(settings.items())]
    digest = hashlib.sha256(json.dumps(held).encode()).hexdigest()[:12]
    return " ".join(part for part in (info["kind"], info["serial_number"], digest) if part)


def nominal_of(info: Mapping[str, Any]) -> float | None:
    """Sensitivity by the data sheet of the device; 1 if the device indicates m/s2; None if it is not known."""
    nominal = info["nominal_sensitivity"]
    return 1.0 if nominal is None and info["unit"] == "m/s2" else nominal


def not_certified(info_json: str, certificate: Certificate) -> str:
    """Why the certificate does not belong to this reference. "" if it may belong: also if one of the two serial numbers
    is not known."""
    told, stated = json.loads(info_json)["serial_number"], certificate.serial_number
    if not told or not stated or told == stated:
        return ""
    return f"the certificate is of serial number {stated}, but the reference has serial number {told}"
