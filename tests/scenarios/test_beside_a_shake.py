"""A sensor beside a Raspberry Shake: `init` hears its datagrams, and `run` calibrates the sensor by its geophones."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config import load_config
from hw.virtual.motion import ambient
from hw.virtual.serial_port import PtyDevice, SampleLines
from hw.virtual.shake_twin import ShakeTwin
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until

THROUGH_S = 120.0  # a window of 60 s; where a busy machine lost samples of it, the next one
GRAVITY_MPS2 = np.array([0.0, 0.0, 9.80665])
RATE_HZ = 100.0
COUNTS = 4e8  # per m/s, as in the metadata of such stations; the noise of the geophone is some counts
CHANNELS = ("EHE", "EHN", "EHZ")
S = np.array([[1.02, 0.004, -0.006], [0.003, 0.985, 0.005], [-0.002, 0.007, 1.01]])
Q_MPS2 = np.array([0.12, -0.2, 0.08])
MOTION = ambient(np.random.default_rng(5), 0.7, 8.0, lines=40, rms_mps2=0.3)


def indications(first: int, n: int) -> NDArray[np.float64]:
    """(n, 3) of the sensor, m/s2."""
    _, _, moved = MOTION.evaluate(np.arange(first, first + n) / RATE_HZ)
    return (moved + GRAVITY_MPS2) @ S.T + Q_MPS2 + np.random.default_rng([1, first]).normal(0.0, 5e-3, (n, 3))


def counts(first: int, n: int) -> NDArray[np.int32]:
    """(n, 3) of the geophones."""
    _, velocity, _ = MOTION.evaluate(np.arange(first, first + n) / RATE_HZ)
    return np.rint(COUNTS * velocity + np.random.default_rng([2, first]).normal(0.0, 5.0, (n, 3))).astype(np.int32)


@contextmanager
def side_by_side() -> Iterator[tuple[PtyDevice, ShakeTwin]]:
    """Both feel the same motion from now on, and both send."""
    began_s, began_ns = time.monotonic(), time.time_ns()

    def due(t_s: float) -> int:
        return int((t_s - began_s) * RATE_HZ) + 1

    sensor = PtyDevice(SampleLines(indications, due))
    shake = ShakeTwin(CHANNELS, counts, lambda: due(time.monotonic()), RATE_HZ, began_ns)
    ended = threading.Event()

    def send() -> None:
        while not ended.wait(0.02):
            shake.serve()

    sending = threading.Thread(target=send)
    sensor.start()
    sending.start()
    try:
        yield sensor, shake
    finally:
        ended.set()
        sending.join()
        shake.close()
        sensor.stop()


@pytest.mark.nightly
def test_a_sensor_beside_three_geophones_becomes_valid(tmp_path: Path) -> None:
    config, data_dir, output = tmp_path / "gateway.toml", tmp_path / "data", tmp_path / "output"
    with side_by_side() as (sensor, shake):
        done = fieldcal(
            "init", config, "--sensor-port", sensor.path, "--reference", "shake-udp", "--reference-option",
            f"port={shake.port}", "--reference-sensitivity", f"{COUNTS:.0f}",
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        assert load_config(config).devices[1].options["channels"] == list(CHANNELS)
        done = fieldcal("check", config)
        assert done.returncode == 0, done.stderr
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(
                lambda: (
                    "VALID" in [status["status"] for status in results(data_dir, "status")]
                    or process.poll() is not None
                ),
                THROUGH_S,
                "VALID",
            )
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    statuses = [status["status"] for status in results(data_dir, "status")]
    assert "VALID" in statuses, statuses
    assert "HELD" not in statuses
    found = results(data_dir, "calibration")[-1]
    u = np.reshape(found["standard_uncertainty"][:9], (3, 3))
    assert (np.abs(np.array(found["sensitivity"]).reshape(3, 3) - S) < 4.0 * u).all()
    assert u.max() < 0.01
    assert all(found["determined"])
