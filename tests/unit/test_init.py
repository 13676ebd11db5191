"""`fieldcal init`: what it writes passes the check, keeps what was stated, and what is missing is told at once."""

from __future__ import annotations

import os
import pty
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import load_config
from agent.setup.buses import bus_clock_khz
from agent.setup.listening import PortLines, _PortBytes, _understood, hear
from agent.setup.toml import TomlSetting, TomlTable, written
from hw.virtual.adxl355_twin import Adxl355Twin
from hw.virtual.kernel import I2CBus, installed
from tests.scenarios.processes import answered

CLAMP = ("--theta-deg", "35", "--alpha-deg", "0,120,240")
LINES = ("rate_hz=200", "axes=1", "sequence=true")


def stated(role: str, *options: str) -> list[str]:
    return [word for option in options for word in (f"--{role}-option", option)]


@pytest.fixture
def chip(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An ADXL355 on bus 4, and no serial port."""
    twin = Adxl355Twin(lambda _, n: np.zeros((n, 3), np.int32), lambda t_s: int(t_s * 1000), time.monotonic)
    monkeypatch.setattr("agent.cli.init.i2c_buses", lambda: [4])
    monkeypatch.setattr("agent.cli.init.serial_ports", list)
    with installed({"/dev/i2c-4": I2CBus({0x1D: twin})}):
        yield


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> list[str]:
    assert run_cli(["init", *map(str, arguments)]) == 2
    return capsys.readouterr().err.splitlines()


@pytest.mark.usefixtures("chip")
def test_a_chip_that_the_probe_finds(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    port = ["--reference-port", "/dev/nowhere", *stated("reference", *LINES)]
    assert run_cli(["init", str(path), "--site", "bridge", *CLAMP, *port, "--calibrated", "2026-03-01"]) == 0
    config = load_config(path)
    sensor, reference = config.devices
    assert (sensor.driver, sensor.options["bus"], sensor.options["address"]) == ("adxl355", 4, 0x1D)
    assert (reference.driver, reference.options["port"]) == ("serial-csv", "/dev/nowhere")
    (channel,) = config.channels
    assert [(stop.theta_deg, stop.alpha_deg) for stop in channel.positions] == [(35, 0), (35, 120), (35, 240)]  # type: ignore[union-attr]
    assert (config.gateway.site, channel.certificate.calibrated) == ("bridge", "2026-03-01")
    assert run_cli(["check", str(path)]) == 0


@pytest.mark.usefixtures("chip")
def test_every_value_has_unit_default_and_source(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    assert run_cli(["init", str(path), "--no-reference"]) == 0
    lines = path.read_text().splitlines()
    comments = ""
    values = 0
    for line in lines:
        if line.startswith("# ") and not line.endswith("="):
            comments += " " + line.removeprefix("# ")
        elif "=" in line and not line.startswith(" "):
            values += 1
            assert "Default: " in comments, line
            assert "Source: " in comments, line
            if line.partition(" ")[0].endswith(("_hz", "_s", "_mps2", "_deg", "_pct")):
                assert "Unit: " in comments, line
            comments = ""
    assert values > 20


@pytest.mark.usefixtures("chip")
def test_rests_without_a_reference(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    assert run_cli(["init", str(path), "--no-reference", "--gravity", "9.8123"]) == 0
    (channel,) = load_config(path).channels
    assert channel.reference is None
    ups = {tuple(float(v) for v in np.array(stop.gravity_mps2)) for stop in channel.positions}  # type: ignore[union-attr]
    assert ups == {tuple(sign * 9.8123 * row) for row in np.eye(3) for sign in (1, -1)}
    assert channel.uncertainty.gravity_mps2 == 2.9e-5, "half the last digit of the stated gravity over root 3"


@pytest.mark.usefixtures("chip")
def test_a_slow_bus_lowers_the_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "class/i2c-adapter/i2c-4/of_node"
    node.mkdir(parents=True)
    (node / "clock-frequency").write_bytes((100_000).to_bytes(4, "big"))
    monkeypatch.setattr("agent.setup.devices.bus_clock_khz", lambda number: bus_clock_khz(number, tmp_path))
    path = tmp_path / "gateway.toml"
    assert run_cli(["init", str(path), "--no-reference"]) == 0
    options = load_config(path).devices[0].options
    assert (options["bus_khz"], options["rate_hz"]) == (100, 125)


@pytest.mark.usefixtures("chip")
def test_the_rate_is_one_that_the_data_sheet_states_for_the_bus(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gateway.toml"
    assert run_cli(["init", str(path), "--no-reference"]) == 0
    assert load_config(path).devices[0].options["rate_hz"] == 500
    capsys.readouterr()
    assert run_cli(["check", str(path)]) == 0
    assert capsys.readouterr().err == ""


def test_a_device_on_spi_that_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    named = ["--sensor", "adxl355", *stated("sensor", "bus=spi0.0")]
    assert run_cli(["init", str(path), "--no-reference", *named]) == 0
    options = load_config(path).devices[0].options
    assert (options["bus"], options["spi_mhz"]) == ("spi0.0", 1.0)
    assert not {"address", "bus_khz"} & set(options)
    assert run_cli(["check", str(path)]) == 0
    text = path.read_text()
    path.write_text(text.replace("spi_mhz = 1.0", "spi_mhz = 1.0\naddress = 0x1D"))
    capsys.readouterr()
    assert run_cli(["check", str(path)]) == 2
    assert "address does not apply to bus spi0.0, remove it" in capsys.readouterr().err
    path.write_text(text.replace('bus = "spi0.0"', "bus = 1"))
    assert run_cli(["check", str(path)]) == 2
    assert "spi_mhz does not apply to bus 1, remove it" in capsys.readouterr().err


@pytest.mark.usefixtures("chip")
def test_beside_a_reference_with_three_axes(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    port = ["--reference-port", "/dev/nowhere", *stated("reference", "rate_hz=100", "axes=3", "sequence=false")]
    assert run_cli(["init", str(path), *port]) == 0
    (channel,) = load_config(path).channels
    assert channel.rotation == (1, 0, 0, 0, 1, 0, 0, 0, 1)


@pytest.mark.usefixtures("chip")
def test_a_geophone_that_sends_datagrams(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    options = stated("reference", 'channels=["EHE", "EHN", "EHZ"]', "source=192.168.1.7")
    arguments = ["--reference", "shake-udp", *options]
    assert "counts" in refused(capsys, path, *arguments)[0]
    assert run_cli(["init", str(path), *arguments, "--reference-sensitivity", "399650000"]) == 0
    config = load_config(path)
    assert (config.devices[1].driver, config.devices[1].options["source"]) == ("shake-udp", "192.168.1.7")
    (channel,) = config.channels
    assert (channel.certificate.quantity, channel.certificate.sensitivity) == ("velocity", 399650000.0)
    assert channel.rotation == (1, 0, 0, 0, 1, 0, 0, 0, 1)
    assert run_cli(["check", str(path)]) == 0
    path.write_text(path.read_text().replace('quantity = "velocity"', 'quantity = "acceleration"'))
    assert run_cli(["check", str(path)]) == 2
    assert 'certificate.quantity: must be "velocity": that is what' in capsys.readouterr().err


def test_all_that_is_missing_is_told_at_once(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    sensor = ["--sensor-port", "/dev/a", *stated("sensor", "rate_hz=100", "axes=3", "sequence=true", "unit=count")]
    reference = ["--reference-port", "/dev/b", *stated("reference", *LINES)]
    told = refused(capsys, path, *sensor, *reference)
    assert [line.split()[2] for line in told] == ["--theta-deg", "--sensitivity"]
    (told_first, *_) = refused(capsys, path, *sensor, *reference, *CLAMP, "--rotation", "1,2")
    assert "Usage" in told_first
    assert not path.exists()


@pytest.mark.usefixtures("chip")
def test_what_cannot_be_used(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    (told,) = refused(capsys, path, "--no-reference", "--sensor", "adxl356")
    assert "no driver 'adxl356': did you mean" in told
    told, *_ = refused(capsys, path, "--no-reference", "--sensor-option", "rate_hz")
    assert "Usage" in told
    (told,) = refused(capsys, path, "--no-reference", *stated("sensor", "rate_hz=990"))
    assert "devices.0.options.rate_hz: 990 Hz is not a rate" in told
    (told,) = refused(capsys, path, "--theta-deg", "35")
    assert "no reference was found" in told
    (told,) = refused(capsys, tmp_path / "nowhere" / "gateway.toml", "--no-reference")
    assert told.endswith("No such file or directory")
    (told,) = refused(capsys, path, "--sensor-port", str(tmp_path / "none"), "--no-reference")
    assert "cannot be opened" in told
    assert "--sensor-option" in told
    assert not path.exists()


def test_an_existing_file_is_never_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text("mine")
    (told,) = refused(capsys, path, "--no-reference", "--sensor", "adxl355")
    assert "the file exists" in told
    assert path.read_text() == "mine"


@pytest.mark.slow
def test_questions_are_asked_on_a_terminal_only(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    options = ["--sensor", "adxl355", "--reference-port", "/dev/nowhere", *stated("reference", *LINES)]
    answered("init", path, *options, typed="35\n0,90,180\nbridge\n\n")
    config = load_config(path)
    assert [stop.alpha_deg for stop in config.channels[0].positions] == [0, 90, 180]  # type: ignore[union-attr]
    assert (config.gateway.site, config.gateway.name) == ("bridge", "gateway")
    assert "Source: answered." in path.read_text()


def test_a_stall_of_the_machine_does_not_change_the_rate() -> None:
    """100 Hz for 3 s. The lines of 0.3 s in the middle and of 0.3 s at the end come late, at once."""
    listened = _PortBytes(None, bytearray())  # type: ignore[arg-type]
    for k in range(300):
        listened.data += b"%d,0.5\n" % (1000 + k)
        if not (120 <= k < 150 or 270 <= k < 299):
            listened.arrivals.append((0.01 * k, len(listened.data)))
    listened.arrivals[-1] = (2.99 + 0.3, len(listened.data))
    heard = _understood(listened, 115200)
    assert isinstance(heard, PortLines), heard
    assert heard.nominal_hz == 100
    assert heard.counted_hz == pytest.approx(100.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("line", "unit"), [(b"0.02,-0.01,1.003", "g"), (b"0.2,-0.1,9.81", "m/s2")])
def test_a_device_at_rest_tells_its_unit(line: bytes, unit: str, tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    with sending(line + b"\n", 0.01) as port:
        reference = ["--reference-port", "/dev/nowhere", *stated("reference", "rate_hz=100", "axes=3", "sequence=true")]
        assert (
            run_cli(["init", str(path), "--sensor-port", port, *reference, *stated("reference", f"unit={unit}")]) == 0
        )
    config = load_config(path)
    assert config.devices[0].options["unit"] == unit
    # 1 g is 9.80665 m/s2 (CGPM 1901); the unit of the sensor needs no statement of its sensitivity
    sensitivity = config.channels[0].certificate.sensitivity
    assert sensitivity == (pytest.approx(1 / 9.80665, rel=1e-12) if unit == "g" else 1.0)
    assert config.channels[0].prior.sensitivity is None
    assert run_cli(["check", str(path)]) == 0


def test_ports_without_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.setup.listening.FIRST_LINE_S", 0.3)
    monkeypatch.setattr("agent.setup.listening.LISTEN_S", 0.3)
    with sending(b"\x00\xff\x81hello\n", 0.01) as binary, sending(b"", 0.01) as silent:
        heard = hear({binary: 9600, silent: 9600, "/dev/none": 9600})
    assert "no lines of numbers at 9600 baud" in str(heard[binary])
    assert str(heard[silent]).startswith("nothing was sent")
    assert "cannot be opened" in str(heard["/dev/none"])


class sending:  # noqa: N801 - used as a function
    """A serial port on which a line is sent every `period_s`."""

    def __init__(self, line: bytes, period_s: float) -> None:
        self._line, self._period_s = line, period_s
        self._stop = threading.Event()

    def __enter__(self) -> str:
        import tty

        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        self._thread = threading.Thread(target=self._send)
        self._thread.start()
        return os.ttyname(self._theirs)

    def _send(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            if self._line:
                os.write(self._ours, self._line)
            due_s += self._period_s

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self._ours)
        os.close(self._theirs)


def test_toml_is_what_tomllib_reads() -> None:
    values: dict[str, Any] = {
        "text": 'a "quoted" \\ \n \x7f ü', "flag": True, "number": 1, "small": 1e-300, "list": [1.5, 2.0],
        "table": {"a b": 1}, "tables": [{"x": 1}, {"x": 2}], "odd key!": "x",
    }  # fmt: skip
    settings = [TomlSetting(name, value, "what it is", "test") for name, value in values.items()]
    text = written("title", [TomlTable("[all]", [*settings, TomlSetting("missing", None, "is left out", "test")])])
    assert tomllib.loads(text) == {"all": values}
