"""Configurations with faults: every one in a line with its path and its value, and nothing but faults."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import pytest

from agent.config import ConfigError, load_config, parse_config
from agent.config.faults import SHOWN_FAULTS
from agent.config.reading import LARGEST_FILE, config_error
from agent.config.size import LONGEST_LIST

DEVICES = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = { port = "/dev/ttyUSB0", rate_hz = 100 }
"""
CHANNEL = DEVICES + '[[channels]]\nsensor = "imu"\nprior = {}\n'
CERTIFICATE = "[channels.certificate]\n"
REST = "gravity_mps2 = [0, 0, 9.8]"


PUBLIC = 'public_key = "' + "A" * 43 + '="'
KEY = f'[[commands.keys]]\nid = "anna"\n{PUBLIC}\nverbs = ["hold"]\nsensors = ["imu"]\n'


def chip(option: str, driver: str = "adxl355") -> str:
    """A configuration whose sensor is a chip with this option."""
    options = f"{{ rate_hz = 500, {option} }}"
    device = f'[[devices]]\nname = "mems"\ndriver = "{driver}"\noptions = {options}\n'
    return f'{device}[[channels]]\nsensor = "mems"\nprior = {{}}\n'


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(tomllib.loads(text), "f.toml")
    return caught.value.faults


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CHANNEL + "silense_s = 3", ["channels.0.silense_s: there is no such setting (3);", "did you mean silence_s?"]),
        (CHANNEL + "silence_s = nan", ["channels.0.silence_s", "not nan"]),
        (CHANNEL + "gravity_mps2 = 981", ["channels.0.gravity_mps2", "not 981"]),
        (CHANNEL + "late_horizon_s = 600", ["channels.0.late_horizon_s", "not 600"]),
        (
            CHANNEL + "windows = 100000",
            ["channels.0.windows: there is no such setting (100000);", "did you mean window_s?"],
        ),
        (CHANNEL + f"poses = [{{ start_s = 0, stop_s = 1.05, {REST} }}]", ["channels.0.poses.0: ", "guard_s 0.5"]),
        (CHANNEL + f"poses = [{{ start_s = 2, stop_s = 1, {REST} }}]", ["channels.0.poses.0", "stop_s 1.0"]),
        (CHANNEL + "[recording]\nrotate_s = 1e308", ["recording.rotate_s", "not 1e+308"]),
        (
            CHANNEL + CERTIFICATE + 'calibrated = "May 2026"',
            ["certificate.calibrated", "as in 2026-03-01", "'May 2026'"],
        ),
        (CHANNEL + CERTIFICATE + "calibrated = 2026-05-01T10:00:00", ["certificate.calibrated", "without a time"]),
        (CHANNEL + CERTIFICATE + "interval_years = 1", ["certificate.interval_years", "add calibrated"]),
        (CHANNEL + CERTIFICATE + "stability_pct = -1", ["certificate.stability_pct", "not -1"]),
        (CHANNEL + "[channels.process]\nreference_pct = 1", ["process.reference_pct", "no such setting"]),
        (CHANNEL + "[recording]\nrotate_bytes = 1", ["recording.rotate_bytes", "not 1"]),
        (CHANNEL + '[zenoh]\nconnect = ["localhost:7447"]', ["zenoh.connect.0", "not 'localhost:7447'"]),
        (CHANNEL + '[zenoh]\nconnect = ["tls/h:7447"]', ["zenoh.connect: ", "zenoh.tls"]),
        (CHANNEL + "[commands]\nenabled = true", ["commands: enabled, but without keys"]),
        (CHANNEL + KEY + KEY, ["commands.keys.1.id: ", "'anna' is used more than once"]),
        (CHANNEL + KEY.replace("AAA=", "AA=="), ["commands.keys.0.public_key", "31 bytes"]),
        (CHANNEL + KEY.replace("AAA=", "A*A="), ["commands.keys.0.public_key", "not base64"]),
        (CHANNEL + KEY.replace('"hold"', '"reboot"'), ["commands.keys.0.verbs.0", "not 'reboot'"]),
        (CHANNEL + KEY.replace('"imu"', '"other"'), ["commands.keys.0.sensors", "'other' has no channel"]),
        (CHANNEL.replace("serial-csv", "serial-cvs"), ["devices.0.driver", "did you mean 'serial-csv'"]),
        (CHANNEL.replace("serial-csv", "Serial-CSV"), ["devices.0.driver", "did you mean 'serial-csv'"]),
        (CHANNEL.replace("rate_hz = 100", "rate_hz = -1"), ["devices.0.options.rate_hz", "not -1"]),
        (chip('address = "0x1D"'), ["devices.0.options.address: must be 29 or 83 as a number without quotes"]),
        (chip('address = "up"'), ["devices.0.options.address: must be 29 or 83, not 'up'"]),
        (chip('bus = "spi0.0"', "mpu6050"), ["devices.0.options.bus: this driver does not read over SPI ('spi0.0')"]),
        (CHANNEL.replace("rate_hz = 100", 'rate_hz = 100, columns = "x,y,z"'), ["options.columns: a list in brackets"]),
        (DEVICES + '[[channels]]\nsensor = "other"\nprior = {}', ["channels.0.sensor", "'other'"]),
        (DEVICES, ["channels"]),
        ("channels = []\n" + DEVICES, ["channels", "at least 1"]),
    ],
)
def test_a_fault_is_one_line_with_its_path_and_value(text: str, said: list[str]) -> None:
    (line,) = faults(text)
    assert line.startswith("f.toml: ")
    for part in said:
        assert part in line


@pytest.mark.parametrize("said", ["connect_private_key_base64=S3cr3t", "iface=eth0;password=S3cr3t"])
def test_an_endpoint_with_a_secret_is_refused_and_not_shown(said: str) -> None:
    (line,) = faults(CHANNEL + f'[zenoh]\nconnect = ["tcp/h:7447#{said}"]')
    assert "zenoh.connect: tcp/h:7447#... contains a key or password" in line
    assert "S3cr3t" not in line
    parse_config(tomllib.loads(CHANNEL + '[zenoh]\nconnect = ["tcp/h:7447#iface=eth0"]'), "")


def test_a_value_is_told_once() -> None:
    (line,) = faults(chip('bus = "i2c-1"'))
    assert line.count("'i2c-1'") == 1


def test_all_faults_come_at_once() -> None:
    lines = faults(CHANNEL.replace("rate_hz = 100", "rate = 100") + "silence_s = 0\n[zenoh]\nconnect = 7")
    assert sorted(line.split(": ")[1] for line in lines) == [
        "channels.0.silence_s",
        "devices.0.options.rate",
        "devices.0.options.rate_hz",
        "zenoh.connect",
    ]


@pytest.mark.parametrize("content", [None, b"\xff\xfe", b"devices = [", b"", b"#" * (LARGEST_FILE + 1)])
def test_a_file_that_is_none_is_a_fault(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "f.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert all(line.startswith(f"{path}: ") for line in caught.value.faults)


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = " + "[" * 200_000, "nested too deep"),
        ("a = " + "{a = " * 100_000, "nested too deep"),
        ("a = " + "9" * 100_000, "not TOML: "),
        (CHANNEL + "windows = 0x" + "f" * 100_000, "channels.0.windows: .*a number of 400000 bits"),
        ("k" * 1_000_000 + " = 1", "kkk"),
        (".".join(["a"] * 1_000_000) + " = 1", "line 1: a key has more than 16 parts"),
        ("\n[" + " . ".join(["'a'"] * 300_000) + "]", "line 2: a key has more than 16 parts"),
        ('x = "' + "y" * 1_000_000 + '"', "x: there is no such setting \\('yyy"),
        (
            CHANNEL + "poses = [" + "1, " * 100_000 + "]",
            f"channels.0.poses: has 100000 entries, at most {LONGEST_LIST} are allowed",
        ),
        ('devices = [{ name = "a" }, ' + '{ name = "a" }, ' * 10_000 + "]", "devices.0.driver"),
        (DEVICES * 1000 + '[[channels]]\nsensor = "imu"', "has too many entries, at most 100 are allowed"),
        ("".join(f"k{i} = 1\n" for i in range(10_000)), f"and {10_002 - SHOWN_FAULTS} more faults"),
    ],
)
def test_a_hostile_file_is_refused_soon_and_in_few_words(tmp_path: Path, text: str, said: str) -> None:
    """Within seconds on a slow machine; unbounded, these took minutes, gigabytes, or ended in a traceback."""
    path = tmp_path / "f.toml"
    path.write_text(text)
    began_s = time.process_time()
    with pytest.raises(ConfigError, match=said) as caught:
        load_config(path)
    assert time.process_time() - began_s < 5.0
    assert len(caught.value.faults) <= SHOWN_FAULTS + 1
    assert max(len(fault) for fault in caught.value.faults) < len(str(path)) + 400


def test_faults_that_are_not_shown_are_counted() -> None:
    fault = (("a",), "wrong")
    assert config_error([fault] * SHOWN_FAULTS, "f", "").faults == ["f: a: wrong"] * SHOWN_FAULTS
    assert config_error([fault] * (SHOWN_FAULTS + 1), "f", "").faults[SHOWN_FAULTS:] == [
        "f: and 1 more faults, not shown"
    ]


def test_files_of_tls_are_checked_with_the_rest(tmp_path: Path) -> None:
    text = CHANNEL + f'[zenoh]\nconnect = []\ntls = {{ ca = "{tmp_path}/a", certificate = "{tmp_path}/b", key = "/c" }}'
    lines = faults(text + "\nenabled = 7")
    assert [line.split(": ")[1] for line in lines] == [
        "zenoh.enabled", "zenoh.tls.ca", "zenoh.tls.certificate", "zenoh.tls.key",
    ]  # fmt: skip
