"""`fieldcal init` beside a Raspberry Shake: what it hears at the UDP port, or what it says where nothing is clear."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import Config, load_config
from hw.virtual.shake_twin import ShakeTwin
from tests.scenarios.processes import answered

SENSOR = ("--sensor", "adxl355", "--reference", "shake-udp", "--reference-sensitivity", "384500")
GEOPHONES, ACCELEROMETERS = ("EHE", "EHN", "EHZ"), ("ENE", "ENN", "ENZ")


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.setup.datagrams.SILENT_S", 1.0)
    monkeypatch.setattr("agent.setup.datagrams.LISTEN_S", 1.2)


@contextmanager
def shake(channels: Sequence[str], rate_hz: float = 100.0, sources: Sequence[str] = ("127.0.0.1",)) -> Iterator[int]:
    """The port to which a Shake sends four times a second for each channel, from each of these addresses."""
    step = round(rate_hz / 4)
    twin = ShakeTwin(
        channels,
        lambda first, n: np.full((n, len(channels)), first, np.int32),
        lambda: 0,
        rate_hz,
        time.time_ns(),
        step,
    )
    ended = threading.Event()

    def send() -> None:
        while not ended.wait(0.25):
            for data in twin.datagrams(twin.next):
                for source in sources:
                    twin.send(data, source)
            twin.next += step

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield twin.port
    finally:
        ended.set()
        thread.join()
        twin.close()


def written(path: Path, port: int, *arguments: str) -> Config:
    assert run_cli(["init", str(path), *SENSOR, "--reference-option", f"port={port}", *arguments]) == 0
    assert run_cli(["check", str(path)]) == 0
    return load_config(path)


def refused(capsys: pytest.CaptureFixture[str], path: Path, port: int, *arguments: str) -> str:
    assert run_cli(["init", str(path), *SENSOR, "--reference-option", f"port={port}", *arguments]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert not path.exists()
    return told


def test_three_geophones_do_not_feel_gravity(tmp_path: Path) -> None:
    turned = ("--rotation", "0,0,1,1,0,0,0,1,0", "--gravity", "9.81")  # x of the sensor points up
    with shake(GEOPHONES) as port:
        config = written(tmp_path / "gateway.toml", port, *turned)
    reference, (channel,) = config.devices[1], config.channels
    assert (reference.options["channels"], reference.options["rate_hz"]) == (list(GEOPHONES), 100.0)
    assert (channel.certificate.quantity, channel.rotation_gravity_mps2) == ("velocity", (9.81, 0.0, 0.0))


def test_an_accelerometer_with_three_axes_is_taken_before_a_single_geophone(tmp_path: Path) -> None:
    with shake(("EHZ", *ACCELEROMETERS)) as port:
        config = written(tmp_path / "gateway.toml", port)
    (channel,) = config.channels
    assert config.devices[1].options["channels"] == list(ACCELEROMETERS)
    assert (channel.certificate.quantity, channel.rotation_gravity_mps2) == ("acceleration", (0.0, 0.0, 0.0))


def test_an_old_one_with_one_geophone_beside_a_barometer(tmp_path: Path) -> None:
    with shake(("HDF", "SHZ"), 50.0) as port:
        config = written(tmp_path / "gateway.toml", port, "--theta-deg", "35")
    options = config.devices[1].options
    assert (options["channels"], options["rate_hz"], options["port"]) == (["SHZ"], 50.0, port)
    assert config.channels[0].rotation is None


@pytest.mark.slow
def test_channels_of_which_nobody_can_say_which_are_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    with shake((*GEOPHONES, *ACCELEROMETERS)) as port:
        told = refused(capsys, path, port)
        assert "--reference-option channels=[...] is missing" in told
        assert "those that came: EHE, EHN, EHZ, ENE, ENN, ENZ" in told
        answered("init", path, *SENSOR, "--reference-option", f"port={port}", typed="ENE, ENN,ENZ\n\n\n")
    assert load_config(path).devices[1].options["channels"] == list(ACCELEROMETERS)


def test_two_senders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    with shake(GEOPHONES, sources=("127.0.0.1", "127.0.0.2")) as port:
        assert "datagrams of 127.0.0.1, 127.0.0.2 came; state source" in refused(capsys, path, port)
        config = written(path, port, "--reference-option", "source=127.0.0.2")
    assert config.devices[1].options["source"] == "127.0.0.2"


def test_why_nothing_is_heard(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        assert "another program receives at this port" in refused(capsys, path, port)
    told = refused(capsys, path, port)
    assert f"UDP port {port} of 0.0.0.0: no datagrams of a Raspberry Shake came within 1 s; state this computer" in told
    assert told.endswith("or state the option channels")
    with shake(GEOPHONES) as port:
        told = refused(capsys, path, port, "--reference-option", "source=192.0.2.1")
    assert "what came from 127.0.0.1 is not used" in told
    assert "--reference-option source: " in refused(capsys, path, port, "--reference-option", "source=rs.local")
    with shake(("HDF",)) as port:
        assert "those that came: HDF" in refused(capsys, path, port)
