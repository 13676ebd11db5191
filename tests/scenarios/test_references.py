"""Every kind of reference, from its driver through the pipeline to S and Q, on the virtual bench with known truth."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from agent.config import parse_config
from agent.core.events import CalibrationUpdate, DeviceChange, Output
from agent.core.pipeline import Pipeline
from hw.sensor import Sensor
from hw.virtual.device import ROTATION, Virtual, VirtualOptions
from hw.virtual.presets import plain

SECONDS = 70.0  # enough for four positions, and for the window of 60 s of a reference that needs no positions


class Machine:
    """A simulated clock for one of two devices; both are read in turn up to the same time."""

    t_s = 0.0

    def clock(self) -> tuple[int, int]:
        ns = round(self.t_s * 1e9)
        return ns, ns

    def sleep(self, seconds: float) -> None:
        self.t_s += seconds


def build(machine: Machine, **options: Any) -> Virtual:
    return Virtual(options["role"], VirtualOptions.model_validate(options), clock=machine.clock, sleep=machine.sleep)


def opened(name: str, sensor: Sensor, machine: Machine) -> DeviceChange:
    ns = machine.clock()[0]
    info = json.dumps(asdict(sensor.open()))
    return DeviceChange(
        device=name, state="open", t_monotonic_ns=ns, t_utc_ns=ns, message="", info_json=info, attempt=0
    )


def calibrated(reference: str, **channel: Any) -> CalibrationUpdate:
    """Run sensor and reference through the pipeline; returns the last calibration."""
    machines = {role: Machine() for role in ("sensor", "reference")}
    devices = {role: build(machine, role=role, reference=reference) for role, machine in machines.items()}
    config = {
        "devices": [{"name": role, "driver": "virtual", "options": {"role": role}} for role in devices],
        "channels": [{"sensor": "sensor", "reference": "reference", "prior": {}} | channel],
    }
    pipeline = Pipeline.begin(parse_config(config, "test"), "run", 0, 0, {})
    results: list[Output] = []
    for role, device in devices.items():
        results += pipeline.step(opened(role, device, machines[role]))
    while machines["sensor"].t_s < SECONDS:
        for device in devices.values():
            block = device.read_block()
            assert block is not None
            results += pipeline.step(block)
    updates = [result for result in results if isinstance(result, CalibrationUpdate)]
    assert updates, results
    return updates[-1]


POSES = {
    "poses": [
        {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
        for p in plain(1).schedule.poses(60.0)
    ]
}


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("reference", "channel"),
    [
        ("preset", POSES),
        ("vibrometer", POSES | {"certificate": {"quantity": "velocity"}}),
        ("tri-axial", {"rotation": ROTATION.ravel().tolist()}),
    ],
)
def test_s_and_q_are_found(reference: str, channel: dict[str, Any]) -> None:
    update = calibrated(reference, **channel)
    truth = plain(1).sensor
    error = np.array(update.sensitivity) / truth.nominal_sensitivity - truth.sensitivity / truth.nominal_sensitivity
    # Angles are known to 0.2 deg, the reference to 0.1 %, offsets to 0.05 m/s2. A wrong unit, axis or phase gives a
    # larger error than this bound.
    assert np.abs(error).max() < 3e-3
    assert np.abs(np.array(update.offset) - truth.offset).max() < 0.05 * truth.nominal_sensitivity
