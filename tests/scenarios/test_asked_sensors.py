"""Two sensors that send no text, side by side: `init` asks them who they are, `run` calibrates one by the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.cli.main import run_cli
from agent.config import load_config
from agent.setup.recognising import recognised
from hw.virtual.epson_twin import EpsonTwin
from hw.virtual.mip_twin import MipTwin
from hw.virtual.serial_port import PtyDevice
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until

GRAVITY_MPS2 = 9.80665
EPSON_HZ, MIP_HZ, VELOCITY_HZ = 200, 100, 3000
EPSON_DELAY_S = 0.063875  # 512 taps: data sheet of the M-A352AD10, table 5.4
TRUE = 1.01  # of the sensor, relative to its data sheet
MIX = np.random.default_rng(7)
FREQUENCY_HZ, PHASE = MIX.uniform(0.5, 12.0, (3, 200)), MIX.uniform(0.0, 2 * np.pi, (3, 200))


def acceleration_mps2(t_s: NDArray[np.float64], delay_s: float, corner_hz: float = np.inf) -> NDArray[np.float64]:
    """(n, 3): 200 sines an axis of 0.1 m/s2 behind a delay and a low-pass filter of first order, and gravity on z."""
    low_pass = 1.0 / (1.0 + 1j * FREQUENCY_HZ / corner_hz)
    phase = PHASE + np.angle(low_pass) - 2 * np.pi * FREQUENCY_HZ * delay_s
    sines = np.abs(low_pass)[:, :, None] * np.sin(2 * np.pi * FREQUENCY_HZ[:, :, None] * t_s + phase[:, :, None])
    return 0.1 * sines.sum(axis=1).T + [0.0, 0.0, GRAVITY_MPS2]


def due(rate_hz: float) -> Callable[[float], int]:
    began_s = time.monotonic()
    return lambda t_s: int((t_s - began_s) * rate_hz) + 1


def epson() -> EpsonTwin:
    def counts(first: int, n: int) -> NDArray[np.int32]:
        g = TRUE * acceleration_mps2(np.arange(first, first + n) / EPSON_HZ, EPSON_DELAY_S) / GRAVITY_MPS2
        return np.rint(g * 2**24).astype(np.int32)

    return EpsonTwin(counts, due(EPSON_HZ))


def vibration_sensor() -> EpsonTwin:
    return EpsonTwin(lambda _, n: np.zeros((n, 3), np.int32), due(VELOCITY_HZ), product=b"A342VD10")


def microstrain() -> MipTwin:
    def rows(first: int, n: int) -> NDArray[np.float64]:
        return acceleration_mps2(np.arange(first, first + n) / MIP_HZ, 0.0, MIP_HZ / 2) / GRAVITY_MPS2

    return MipTwin(rows, due(MIP_HZ), MIP_HZ)


@contextmanager
def plugged(directory: Path, **twins: EpsonTwin | MipTwin) -> Iterator[list[str]]:
    with ExitStack() as stack:
        paths = []
        for name, twin in twins.items():
            port = PtyDevice(twin.text_due, link=directory / name, received=twin.received)
            port.start()
            stack.callback(port.stop)
            paths.append(str(port.path))
        yield paths


@pytest.mark.nightly
def test_init_finds_both_and_run_calibrates(tmp_path: Path) -> None:
    path, data_dir = tmp_path / "gateway.toml", tmp_path / "data"
    with plugged(tmp_path, epson=epson(), mip=microstrain()) as (sensor, reference):
        made = fieldcal("init", path, "--sensor-port", sensor, "--reference-port", reference)
        assert made.returncode == 0, made.stderr
        config = load_config(path)
        assert [device.driver for device in config.devices] == ["epson", "mip"]
        assert [device.options["baud_rate"] for device in config.devices] == [460800, 115200]
        assert fieldcal("check", path).returncode == 0
        with started("run", path, "--data-dir", data_dir, output=tmp_path / "output") as agent:
            wait_until(
                lambda: [s for s in results(data_dir, "status") if s["status"] == "VALID"], 400, "VALID"
            )  # a window of 60 s; where samples are lost on a busy machine, another one
            interrupt(agent)
    found = results(data_dir, "calibration")[-1]
    s = np.reshape(found["sensitivity"], (3, 3))
    u = found["coverage_factor"] * np.reshape(found["standard_uncertainty"][:9], (3, 3))
    assert (np.abs(s - TRUE / GRAVITY_MPS2 * np.eye(3)) < u).all()
    assert (np.diag(u) < 0.05 * TRUE / GRAVITY_MPS2).all()  # measured: 2 %
    assert (np.abs(np.diag(s) / TRUE * GRAVITY_MPS2 - 1.0) < 0.005).all()  # measured: 0.1 %


def test_init_finds_a_velocity_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.setup.listening.FIRST_LINE_S", 0.3)
    path = tmp_path / "gateway.toml"
    with plugged(tmp_path, mip=microstrain(), vibration=vibration_sensor()) as (sensor, reference):
        assert run_cli(["init", str(path), "--sensor-port", sensor, "--reference-port", reference]) == 0
    config = load_config(path)
    assert [device.driver for device in config.devices] == ["mip", "epson"]
    assert (config.devices[1].options["unit"], config.devices[1].options["rate_hz"]) == ("m/s", 3000)
    assert config.channels[0].certificate.quantity == "velocity"
    assert run_cli(["check", str(path)]) == 0


def test_a_sensor_at_another_baud_rate_and_a_port_without_one(tmp_path: Path) -> None:
    with plugged(tmp_path, epson=epson()) as (port,):
        # A pseudo-terminal has no baud rate: the first one that is tried answers, or the one that is stated.
        # It waits 0.1 s for an answer, and this test's own process, which answers, may get no processor for so long.
        found = wait_until(lambda: recognised(port, 115200), 60, "an answer")
        assert (found.driver, found.options) == ("epson", {"baud_rate": 115200, "unit": "g"})
    assert recognised(str(tmp_path / "none")) is None
