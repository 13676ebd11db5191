"""The clock of an I2C bus, as the device tree of this machine states it."""

from __future__ import annotations

from pathlib import Path

SYSFS = Path("/sys")


def bus_clock_khz(number: int, sysfs: Path = SYSFS) -> float | None:
    """Clock of /dev/i2c-`number` in kHz; None where the system does not tell, as with USB adapters."""
    try:
        raw = (sysfs / f"class/i2c-adapter/i2c-{number}/of_node/clock-frequency").read_bytes()
    except OSError:
        return None
    return int.from_bytes(raw, "big") / 1e3 if len(raw) == 4 else None
