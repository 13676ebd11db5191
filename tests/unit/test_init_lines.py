"""`fieldcal init` on devices that write lines of text: what it writes is read without a loss, or it asks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from serial.tools.list_ports_common import ListPortInfo

from agent.cli.main import run_cli
from agent.config import load_config
from agent.setup.listening import PortLines, hear
from hw.block import BlockFlags, SampleBlock
from hw.sensor import Sensor, load_driver
from hw.serial_ports import lasting_name, serial_ports
from hw.virtual.serial_port import PtyDevice
from tests.scenarios.processes import answered

RATE_HZ = 100
ANGLES = ("--theta-deg", "35", "--alpha-deg", "0,120,240")
REST = "0.12,-0.05,9.80"


@pytest.fixture(autouse=True)
def _listen_shortly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.setup.listening.LISTEN_S", 1.2)
    monkeypatch.setattr("agent.setup.listening.FIRST_LINE_S", 2.0)


@contextmanager
def writing(line: Callable[[int], str], greeting: bytes = b"", link: Path | None = None) -> Iterator[str]:
    """The port of a device that writes `greeting` once, then line k and its end k / RATE_HZ later."""
    began_s, written = time.monotonic(), 0

    def due(t_s: float) -> bytes:
        nonlocal written
        first, written = written, int((t_s - began_s) * RATE_HZ)
        return (greeting if not first else b"") + b"".join(line(k).encode("latin-1") for k in range(first, written))

    device = PtyDevice(due, link=link)
    device.start()
    try:
        yield str(device.path)
    finally:
        device.stop()


def init(path: Path, port: str, *options: str) -> int:
    stated = [word for option in options for word in ("--sensor-option", option)]
    return run_cli(["init", str(path), "--no-reference", "--sensor-port", port, *stated])


def read(sensor: Sensor, samples: int) -> Iterator[SampleBlock]:
    """Blocks until they hold so many samples; in a minute they must have come."""
    ends_s = time.monotonic() + 60.0
    while samples > 0:
        assert time.monotonic() < ends_s, f"{samples} samples are missing"
        block = sensor.read_block()
        if block is not None:
            samples -= block.n
            yield block


DECIDED: dict[str, tuple[Callable[[int], str], dict[str, Any]]] = {
    "seq,x,y,z": (lambda k: f"{k},{REST}\n", {"axes": 3, "sequence": True}),
    "8-bit counter": (lambda k: f"{k % 256},{REST}\n", {"axes": 3, "sequence": True}),
    "int16 counter": (lambda k: f"{(k + 32700 + 2**15) % 2**16 - 2**15},{REST}\n", {"axes": 3, "sequence": True}),
    "x,y,z": (lambda _: f"{REST}\n", {"axes": 3, "sequence": False}),
    "millis": (
        lambda k: f"{10 * k + 7},{REST}\n",
        {"axes": 3, "sequence": False, "columns": ["millis", "x", "y", "z"]},
    ),
    "micros at the end": (
        lambda k: f"{REST},{(4294000000 + 10000 * k + k % 13) % 2**32}\n",
        {"axes": 3, "sequence": False, "columns": ["x", "y", "z", "micros"]},
    ),
    "seq,millis,x,y,z": (
        lambda k: f"{k},{10 * k},{REST}\n",
        {"axes": 3, "sequence": True, "columns": ["seq", "millis", "x", "y", "z"]},
    ),
    "blanks": (lambda k: f"{k} {REST}\n".replace(",", "  "), {"axes": 3, "sequence": True}),
    "tabs": (lambda k: f"{k},{REST},\r\n".replace(",", "\t"), {"axes": 3, "sequence": True}),
    "semicolons": (lambda k: f"{k},{REST},\r\n".replace(",", ";"), {"axes": 3, "sequence": True}),
    "trailing comma": (lambda _: f"{REST},\r\n", {"axes": 3, "sequence": False}),
    "CR alone": (lambda k: f"{k},{REST}\r", {"axes": 3, "sequence": True}),
    "header again and again": (lambda k: f"{REST}\n" if k % 50 else f"ax,ay,az\n{REST}\n", {"axes": 3}),
}


@pytest.mark.one_case
@pytest.mark.parametrize("name", DECIDED)
def test_what_init_writes_is_read_without_a_loss(name: str, tmp_path: Path) -> None:
    line, options = DECIDED[name]
    path = tmp_path / "gateway.toml"
    with writing(line) as port:
        assert init(path, port) == 0
        assert run_cli(["check", str(path)]) == 0
        written = load_config(path).devices[0].options
        assert {name: written[name] for name in options} == options
        assert ("columns" in options) == bool(written["columns"])
        assert written["unit"] == "m/s2"
        assert written["rate_hz"] == pytest.approx(RATE_HZ, rel=0.1)  # how near, tests/unit/test_init.py says
        driver = load_driver("serial-csv")
        sensor = driver("sensor", driver.options_model.model_validate(written))
        sensor.open()
        try:
            blocks = list(read(sensor, samples=120))
        finally:
            sensor.close()
    if "header" not in name:
        assert [block.flags for block in blocks] == [BlockFlags.RESTART] + [BlockFlags.NONE] * (len(blocks) - 1)
        assert sensor.take_drops() == []
    assert {tuple(row) for block in blocks for row in block.indications.tolist()} == {(0.12, -0.05, 9.8)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "count"),
    [
        (lambda k: f"{REST},23.{k % 10}\n", 4),
        (lambda k: f"{k % 50},{REST}\n", 4),
        (lambda k: f"{k},{REST},23.5\n", 5),
        (lambda k: f"{10 * k},{REST},0.1,0.2,0.3\n", 7),
        (lambda _: "0.1,9.8\n", 2),
        (lambda k: f"{k}\n", 1),
    ],
)
def test_columns_that_cannot_be_told_apart_are_asked(
    line: Callable[[int], str], count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gateway.toml"
    with writing(line) as port:
        assert init(path, port) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith("fieldcal init: --sensor-option columns=[...] is missing: ")
    assert f"what the {count} columns of its lines are, as in '" in told
    assert not path.exists()


def test_where_few_lines_came_it_listens_until_a_counter_has_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A slow device, or a busy machine: a counter to 50 looks like a sample counter for half a second."""
    monkeypatch.setattr("agent.setup.listening.LISTEN_S", 0.1)
    with writing(lambda k: f"{k % 50},{REST}\n") as port:
        assert init(tmp_path / "gateway.toml", port) == 2
    assert "what the 4 columns of its lines are" in capsys.readouterr().err


def test_a_device_with_one_axis_is_no_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with writing(lambda k: f"{k},0.0{k % 7}\n") as port:
        assert init(tmp_path / "gateway.toml", port) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert "sensor: its lines have one axis" in told
    assert "can be the reference (--reference-port)" in told


def test_the_columns_as_an_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    columns = 'columns=["x","y","z","temperature"]'
    with writing(lambda _: f"{REST},23.5\n") as port:
        assert init(path, port, 'columns=["x","y","z"]') == 2
        assert "3 columns do not fit its lines of 4 columns, as '0.12,-0.05,9.80,23.5'" in capsys.readouterr().err
        assert init(path, port, "sequence=true") == 2
        assert "--sensor-option columns=[...] is missing" in capsys.readouterr().err
        assert init(path, port, columns, "axes=1") == 2
        assert "axes = 1" in capsys.readouterr().err
        assert init(path, port, columns) == 0
    options = load_config(path).devices[0].options
    assert (options["columns"], options["axes"], options["sequence"]) == (["x", "y", "z", "temperature"], 3, False)


def test_stated_lines_are_not_listened_to(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    assert init(path, "/dev/nowhere", 'columns=["seq","a","-"]', "rate_hz=50", "unit=g") == 0
    options = load_config(path).devices[0].options
    assert (options["columns"], options["axes"], options["sequence"]) == (["seq", "a", "-"], 1, True)


@pytest.mark.thorough
def test_the_columns_on_a_terminal(tmp_path: Path) -> None:
    path = tmp_path / "gateway.toml"
    with writing(lambda _: f"{REST},23.5\n") as port:
        answered(
            "init", path, "--sensor-port", port, "--no-reference", typed="x,y,z,warm\nx, y, z, temperature\nbridge\n\n"
        )
    assert load_config(path).devices[0].options["columns"] == ["x", "y", "z", "temperature"]
    assert "Source: answered." in path.read_text()


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("1,5;2,3;9,8\n", "(line with decimal commas: let the device write decimal points, as '1,5;2,3;9,8')"),
        ("X:1.0,Y:2.0,Z:9.8\n", "(line with names before its numbers: let the device write the numbers alone, as 'X:1"),
        ("nan,nan,nan\n", "(line without the expected decimal numbers, as 'nan,nan,nan')"),
        ("\x1b[2J\x00\xff\n", "(line without the expected decimal numbers, as '\\x1b[2J\\x00\\\\xff')"),
        ("x" * 300 + "\n", "(no newline within the longest line, as 'xxxx"),
    ],
)
def test_lines_that_cannot_be_read_are_told_with_the_reason(line: str, told: str) -> None:
    with writing(lambda _: line) as port:
        heard = hear({port: 115200})[port]
    assert told in str(heard)


def test_every_second_line_is_something_else() -> None:
    with writing(lambda k: f"{REST}\n" if k % 2 else "gyro 0.1 0.2 0.3\n") as port:
        heard = hear({port: 115200})[port]
    assert "lines cannot be read (line without the expected decimal numbers, as 'gyro 0.1 0.2 0.3')" in str(heard)


def test_a_board_that_starts_when_its_port_is_opened() -> None:
    """3 kB of text before the lines do not change the rate, and are no reason to refuse them."""
    boot = b"ets Jun  8 2016 00:22:57\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)\r\n" * 35
    with writing(lambda k: f"{k},{REST}\r\n", greeting=boot) as port:
        heard = hear({port: 115200})[port]
    assert isinstance(heard, PortLines), heard
    assert heard.columns == ("seq", "x", "y", "z")
    assert heard.nominal_hz == pytest.approx(RATE_HZ, rel=0.1)  # with the 3 kB it would be half of it


def adapters(folder: Path, *of: tuple[str, str | None, str]) -> list[ListPortInfo]:
    """Ports of USB adapters (device, serial number, place), with the links that udev makes for them."""
    found = []
    for device, number, place in of:
        port = ListPortInfo(str(folder / device))
        port.vid, port.pid, port.serial_number, port.location = 0x1A86, 0x7523, number, place
        port.description = "USB Serial"
        interface = place.rpartition(".")[2]
        for kind, name in ("by-id", f"usb-1a86_{number or 'USB_Serial'}-if0{interface}"), ("by-path", f"usb-{place}"):
            (folder / kind).mkdir(exist_ok=True)
            (folder / kind / name).unlink(missing_ok=True)  # the adapter that is found last gets the link
            (folder / kind / name).symlink_to(folder / device)
        found.append(port)
    return found


@pytest.mark.parametrize(
    ("first", "second", "names"),
    [
        (("A1", "1-1:1.0"), ("A2", "1-2:1.0"), ["by-id/usb-1a86_A1-if00", "by-id/usb-1a86_A2-if00"]),
        ((None, "1-1:1.0"), (None, "1-2:1.0"), ["by-path/usb-1-1:1.0", "by-path/usb-1-2:1.0"]),
        (("0001", "1-1:1.0"), ("0001", "1-2:1.0"), ["by-path/usb-1-1:1.0", "by-path/usb-1-2:1.0"]),
        # one adapter with two ports
        (("A1", "1-1:1.0"), ("A1", "1-1:1.1"), ["by-id/usb-1a86_A1-if00", "by-id/usb-1a86_A1-if01"]),
    ],
)
def test_lasting_names(
    first: tuple[str | None, str],
    second: tuple[str | None, str],
    names: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = adapters(tmp_path, ("ttyUSB0", *first), ("ttyUSB1", *second))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    monkeypatch.setattr("hw.serial_ports.LINKS", tmp_path)
    assert [port["port"] for port in serial_ports()] == [str(tmp_path / name) for name in names]
    assert lasting_name(str(tmp_path / "ttyUSB1")) == str(tmp_path / names[1])
    assert lasting_name(str(tmp_path / "ttyUSB7")) == str(tmp_path / "ttyUSB7")


def test_init_writes_the_lasting_name_of_a_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, place = tmp_path / "gateway.toml", tmp_path.resolve()
    found = adapters(place, ("ttyUSB0", "A1", "1-1:1.0"))
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    monkeypatch.setattr("hw.serial_ports.LINKS", place)
    stated = ("rate_hz=100", "axes=3", "sequence=true")
    assert init(path, str(place / "ttyUSB0"), *stated) == 0
    assert load_config(path).devices[0].options["port"] == str(place / "by-id/usb-1a86_A1-if00")
    assert f"Source: option --sensor-port {place}/ttyUSB0" in path.read_text().replace("\n# ", " ")
