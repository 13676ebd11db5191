"""What a run says at its beginning where the first mean of a device is not gravity by the stated sensitivity."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.acquisition.weighing import FIRST_S, Weighing
from agent.cli.main import run_cli
from agent.config import Config, parse_config
from agent.core.events import DeviceChange
from hw.block import DeviceInfo, SampleBlock

RATE_HZ = 100.0
COUNTS_PER_MPS2 = 26000.0
IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
TILTED = 9.81 * np.array([0.6, 0.0, 0.8])
OFFSET = 9.81 * np.array([0.075, -0.075, 0.075])  # the largest that data sheets of MEMS accelerometers state


def config_of(unit: str = "count", **channel: Any) -> Config:
    devices = [
        {"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ, "unit": unit}} for n in "sr"
    ]
    stated = {"sensor": "s", "reference": "r", "rotation": IDENTITY, "prior": {"sensitivity": COUNTS_PER_MPS2}}
    return parse_config({"devices": devices, "channels": [stated | channel]}, "test")


def said(config: Config, device: str, indications: np.ndarray, unit: str = "count") -> list[str]:
    """What is said of a device with these indications (n, axes), in blocks of half a second."""
    info = DeviceInfo("serial-csv", "serial-csv", "1", unit, 3 if indications.shape[1] == 3 else 1, RATE_HZ)
    weighing, size = Weighing(config), round(RATE_HZ / 2)
    opened = DeviceChange(device=device, state="open", t_monotonic_ns=0, t_utc_ns=0, info_json=json.dumps(asdict(info)))
    found = weighing.messages(opened)
    for first in range(0, len(indications), size):
        part = indications[first : first + size]
        at = np.array([first], dtype=np.int64)
        block = SampleBlock(device, "boot", 0, first, RATE_HZ, at, np.array([len(part)], dtype=np.int32), part)
        found += weighing.messages(block)
    return found


def moving(mean: np.ndarray, seconds: float = 2.0 * FIRST_S) -> np.ndarray:
    """A motion of 20 m/s2 about a mean."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return mean + 20.0 * np.sin(2.0 * np.pi * 7.3 * t)[:, None] * np.array([0.3, 0.9, 0.3])


@pytest.mark.parametrize("mean", [TILTED, TILTED + OFFSET, -TILTED + OFFSET])
def test_a_right_sensitivity_is_not_doubted_whatever_the_position_offset_and_motion(mean: np.ndarray) -> None:
    assert said(config_of(), "s", COUNTS_PER_MPS2 * moving(mean)) == []


@pytest.mark.parametrize("factor", [9.80665, 1.0 / 9.80665, 2.0, 0.5])
def test_a_wrong_one_is_told_once_with_the_one_that_gravity_shows(factor: float) -> None:
    config = config_of(prior={"sensitivity": COUNTS_PER_MPS2 * factor})
    (line,) = said(config, "s", COUNTS_PER_MPS2 * moving(TILTED, 60.0))
    assert line.startswith("s: its first mean has the length 2.5")
    assert "about 2.6" in line
    assert f"it is {9.81 / factor:.1f}"[:7] in line
    assert "correct prior.sensitivity" in line


def test_nothing_is_said_of_what_does_not_feel_gravity_or_was_not_heard_for_long() -> None:
    wrong = config_of(prior={"sensitivity": 1.0})
    assert said(wrong, "s", COUNTS_PER_MPS2 * moving(TILTED, 0.5 * FIRST_S)) == []
    assert said(config_of(prior={"sensitivity": 1.0}, coupling="ac"), "s", COUNTS_PER_MPS2 * moving(TILTED)) == []
    assert said(wrong, "r", moving(np.zeros(3))) == []
    assert said(wrong, "r", moving(TILTED)) == []
    uniaxial = config_of(rotation=None)
    assert said(uniaxial, "r", moving(50.0 * TILTED)[:, :1]) == []


def test_a_reference_in_counts_is_told() -> None:
    (line,) = said(config_of(), "r", COUNTS_PER_MPS2 * moving(TILTED))
    assert line.startswith("r: ")
    assert "correct certificate.sensitivity" in line


@pytest.mark.thorough
def test_a_run_logs_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The virtual bench indicates 26,000 counts per m/s2, and the prior states counts per g."""
    text = "".join(
        f'[[devices]]\nname = "{role}"\ndriver = "virtual"\noptions = {{ role = "{role}", speed = 10 }}\n'
        for role in ("sensor", "reference")
    )
    text += '[[channels]]\nsensor = "sensor"\nreference = "reference"\npositions = "free"\n'
    text += "[channels.prior]\nsensitivity = 255000\n[zenoh]\nenabled = false\n"
    (tmp_path / "f.toml").write_text(text)
    command = ["run", str(tmp_path / "f.toml"), "--data-dir", str(tmp_path / "data"), "--log", "plain"]
    assert run_cli([*command, "--duration", "3"]) == 0
    assert "sensor: its first mean has the length" in caplog.text
