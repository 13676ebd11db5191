"""kill -9: the next start goes on with the calibration in force, the torn recording replays up to its last flush."""

from __future__ import annotations

import itertools
import json
import random
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.channel import identity_of
from agent.config import load_config
from agent.delivery.history import Record
from agent.delivery.store import Store
from agent.events import CalibrationUpdate, Command, DeviceChange
from agent.pipeline import Pipeline
from agent.recording.reading import RecordingReader
from hw.serial_stream import SerialCsv, SerialCsvOptions
from hw.virtual.serial_port import PtyDevice
from tests.scenarios.processes import fieldcal, recordings, results, started, wait_until

KILLS = 8
SEED = 20261121
LOST_S = 5.0  # the most that a kill may cost
CONFIG = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 100, axes = 3, sequence = true, unit = "m/s2", serial_number = "A1" }}
[[channels]]
sensor = "imu"
prior = {{}}
guard_s = 0.1
poses = [{{ start_s = 0, stop_s = 1, gravity_mps2 = [0, 0, 9.81] }}]
poses_repeat_s = 1
[recording]
rotate_s = 3
[zenoh]
enabled = false
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyDevice]:
    numbers = itertools.count()
    began_s = time.monotonic()
    sent = 0

    def text_due(t_s: float) -> bytes:
        nonlocal sent
        due = int((t_s - began_s) * 100) - sent
        sent += due
        return "".join(f"{next(numbers)},0.01,-0.02,9.81\n" for _ in range(due)).encode()

    device = PtyDevice(text_due, link=tmp_path / "port")
    device.start()
    yield device
    device.stop()


def keep_calibration(data_dir: Path, port: Path, config: Path) -> CalibrationUpdate:
    """What a run before left in the store: a calibration of this very device, put in force by an operator."""
    data_dir.mkdir()
    options = SerialCsvOptions(port=str(port), rate_hz=100, axes=3, sequence=True, unit="m/s2", serial_number="A1")
    sensor = SerialCsv("imu", options)
    info_json = json.dumps(asdict(sensor.open()))
    sensor.close()
    calibration = CalibrationUpdate(
        run_id="before", sequence=1, sensor="imu", t_utc_ns=1,
        sensitivity=[[1.01, 0.002, 0.1], [0, 1, 0], [0, 0, 1]],
        offset=[0.1, 0.2, 0.3], standard_uncertainty=[1e-3] * 12, covariance=(1e-6 * np.eye(12)).tolist(),
        coverage_factor=2.0, determined=[True] * 12, method="3", uncertainty_kind="combined", windows=4,
        residual_sd=[0.1, 0.1, 0.1], output_unit="m/s2", identity=identity_of(info_json),
    )  # fmt: skip
    store = Store(data_dir)
    pipeline = Pipeline.begin(load_config(config), "before", 0, store.last_sequence(), {})
    times = {"t_monotonic_ns": 1, "t_utc_ns": 1}
    for event in (
        DeviceChange(device="imu", state="open", info_json=info_json, **times),
        Command(sensor="imu", verb="rollback", calibration_json=msgspec.json.encode(calibration).decode(), **times),
    ):
        found = pipeline.step(event)
        store.commit([Record.of(r, recorded=True, recording="") for r in found], pipeline.memories(found))
    store.close()
    return calibration


def test_killed_at_random_moments_it_goes_on(tmp_path: Path, port: PtyDevice) -> None:
    data_dir, output = tmp_path / "data", tmp_path / "output"
    config = tmp_path / "config.toml"
    config.write_text(CONFIG.format(port=port.path))
    kept = keep_calibration(data_dir, port.path, config)
    moments = random.Random(SEED)
    for kill in range(KILLS):
        before = len(recordings(data_dir))
        with started("run", config, "--data-dir", data_dir, output=output) as agent:
            wait_until(lambda n=before: len(recordings(data_dir)) > n, 20, "it records")
            began_ns = time.monotonic_ns()
            time.sleep(moments.uniform(0.0, 5.0))  # the moment of the kill
            killed_ns = time.monotonic_ns()
            agent.kill()
            agent.wait()
        new = recordings(data_dir)[before:]
        held = {path: [step.event.t_monotonic_ns for step in RecordingReader(path).steps()] for path in new}
        # A kill between making a file and its first flush leaves one without an event: nothing of it was flushed.
        last_ns = max((max(times) for times in held.values() if times), default=began_ns)
        assert (killed_ns - last_ns) * 1e-9 < LOST_S, kill
        for path in [path for path, times in held.items() if times]:
            replayed = fieldcal("replay", path, "--json", "-")
            assert replayed.returncode == 0, replayed.stdout + replayed.stderr
        audited = fieldcal("audit", new[-1])
        assert (audited.returncode, "incomplete" in audited.stdout) == (3, True), audited.stdout
    restored = len(results(data_dir, "calibration"))
    with started("run", config, "--data-dir", data_dir, output=output) as agent:
        wait_until(lambda: len(results(data_dir, "calibration")) > restored, 20, "it is in force again")
        agent.terminate()
        agent.wait(10)
    assert agent.returncode == 0
    in_force = results(data_dir, "calibration")[-1]
    assert results(data_dir, "status")[-1]["reason"] == "restored from the run before"
    assert in_force["sensitivity"] == kept.sensitivity
    assert in_force["offset"] == kept.offset
    assert "Traceback" not in output.read_text()


def test_a_calibration_of_another_device_is_not_taken(tmp_path: Path, port: PtyDevice) -> None:
    data_dir = tmp_path / "data"
    config = tmp_path / "config.toml"
    config.write_text(CONFIG.format(port=port.path))
    keep_calibration(data_dir, port.path, config)
    config.write_text(CONFIG.format(port=port.path).replace('"A1"', '"B2"'))
    with started("run", config, "--data-dir", data_dir, output=tmp_path / "output") as agent:
        wait_until(lambda: "belongs to" in (tmp_path / "output").read_text(), 20, "it says whose it is")
        agent.terminate()
        agent.wait(10)
    assert len(results(data_dir, "calibration")) == 1
