"""Requests of driver `iio` that the kernel refuses, as JSON. Run in the machine, with the trigger `lsm6dso` present."""

from __future__ import annotations

import json
from typing import Any

from hw.iio import Iio, IioOptions
from hw.sensor import DeviceError

LSM6DSO = {"device": "lsm6dsox_accel", "trigger": "lsm6dso"}
RATE_HZ = 26.0


def opened(options: dict[str, Any]) -> str:
    """Message when the driver is opened with these options."""
    sensor = Iio("sensor", IioOptions.model_validate(options))
    try:
        sensor.open()
    except DeviceError as error:
        return f"{type(error).__name__}: {error}"
    sensor.close()
    return "opened"


def refusals() -> dict[str, str]:
    """Messages by question."""
    found = {
        "a rate that is rounded": opened(LSM6DSO | {"rate_hz": 100}),
        "a rate that is refused": opened(LSM6DSO | {"rate_hz": 5000}),
        "no buffer": opened({"device": "mpu6050", "rate_hz": 50}),
    }
    first = Iio("first", IioOptions.model_validate(LSM6DSO | {"rate_hz": RATE_HZ}))
    first.open()
    before = first.read_block()
    found["another process reads the device"] = opened(LSM6DSO | {"rate_hz": RATE_HZ})
    after = first.read_block()
    first.close()
    found["the first reader continues"] = "samples arrive" if before and after else "no samples"
    return found


if __name__ == "__main__":
    print(json.dumps(refusals()))
