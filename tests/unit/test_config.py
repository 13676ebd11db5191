"""Configurations with faults: every one in a line with its path and its value, and nothing but faults."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from agent.config import ConfigError, load_config, parse_config
from agent.config.reading import LARGEST_FILE

DEVICES = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = { port = "/dev/ttyUSB0", rate_hz = 100 }
"""
CHANNEL = DEVICES + '[[channels]]\nsensor = "imu"\nprior = {}\n'
REST = "gravity_mps2 = [0, 0, 9.8]"


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(tomllib.loads(text), "f.toml")
    return caught.value.faults


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CHANNEL + "silense_s = 3", ["channels.0.silense_s", "not 3"]),
        (CHANNEL + "silence_s = nan", ["channels.0.silence_s", "not nan"]),
        (CHANNEL + "gravity_mps2 = 981", ["channels.0.gravity_mps2", "not 981"]),
        (CHANNEL + "late_horizon_s = 600", ["channels.0.late_horizon_s", "not 600"]),
        (CHANNEL + "windows = 100000", ["channels.0.windows", "not 100000"]),
        (CHANNEL + f"poses = [{{ start_s = 0, stop_s = 1.05, {REST} }}]", ["channels.0", "poses.0", "guard_s 0.5"]),
        (CHANNEL + f"poses = [{{ start_s = 2, stop_s = 1, {REST} }}]", ["channels.0.poses.0", "stop_s 1.0"]),
        (CHANNEL + "[recording]\nrotate_s = 1e308", ["recording.rotate_s", "not 1e+308"]),
        (CHANNEL + "[recording]\nrotate_bytes = 1", ["recording.rotate_bytes", "not 1"]),
        (CHANNEL + '[zenoh]\nconnect = ["localhost:7447"]', ["zenoh.connect.0", "not 'localhost:7447'"]),
        (CHANNEL.replace("serial-csv", "serial-cvs"), ["devices.0.driver", "did you mean 'serial-csv'"]),
        (CHANNEL.replace("rate_hz = 100", "rate_hz = -1"), ["devices.0.options.rate_hz", "not -1"]),
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
