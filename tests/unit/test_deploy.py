"""The systemd unit: systemd knows every key in it, thinks it tight, and the agent gets what it needs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from agent.cli.run import run
from tests.faults.limits import directives

UNIT = Path(__file__).parents[2] / "deploy" / "fieldcal.service"
EXPOSURE_MAX = 2.0


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    # The program is where the unit says only on a gateway; that one complaint must not hide another.
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/fieldcal/.venv/bin/fieldcal", "/bin/true"))
    return unit


def verified(unit: Path) -> list[str]:
    told = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    # It exits 0 even for a key it does not know: only what it says counts.
    return [line for line in told.stderr.splitlines() if UNIT.name in line]


def test_systemd_understands_the_unit(unit: Path) -> None:
    assert verified(unit) == []
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    assert len(verified(unit)) == 1, "what it does not know is told"


def test_systemd_thinks_it_tight(unit: Path) -> None:
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", unit],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    (exposure,) = re.findall(r"Overall exposure level for \S+: ([0-9.]+)", told.stdout)
    assert float(exposure) <= EXPOSURE_MAX, told.stdout


def test_what_the_hardening_test_takes_on_is_in_it() -> None:
    said = directives(UNIT)
    for key in ("NoNewPrivileges", "MemoryDenyWriteExecute", "RestrictNamespaces", "ProtectHome"):
        assert said[key] == ["yes"], key
    assert (said["ProtectSystem"], said["CapabilityBoundingSet"], said["User"]) == (["strict"], [""], ["fieldcal"])
    assert said["SystemCallFilter"] == ["@system-service", "~@privileged @resources"]
    assert said["SystemCallErrorNumber"] == ["EPERM"], "OpenBLAS calls mbind when numpy loads, and would be killed"


def test_it_is_supervised_and_started_again_for_ever() -> None:
    said = directives(UNIT)
    assert (said["Type"], said["Restart"], said["StartLimitIntervalSec"]) == (["notify"], ["on-failure"], ["0"])
    assert said["WatchdogSec"] == ["2min"]
    assert said["RestartPreventExitStatus"] == ["2"], "a refused configuration stays refused"


def test_devices_are_let_through_and_no_others() -> None:
    said = directives(UNIT)
    assert said["DevicePolicy"] == ["closed"]
    devices = ("char-i2c", "char-spi", "char-iio", "char-ttyUSB", "char-ttyACM")
    assert said["DeviceAllow"] == [f"{device} rw" for device in devices]
    assert "PrivateDevices" not in said, "it would hide them all"
    assert "ProcSubset" not in said, "the name of the boot stands in /proc/sys"
    assert said["ReadWritePaths"] == ["-/sys/devices"], "kernel drivers are set through sysfs"


def test_the_command_in_it_is_one_that_exists() -> None:
    (line,) = directives(UNIT)["ExecStart"]
    _, command, *arguments = line.split()
    assert command == run.name
    assert (
        run.make_context("run", arguments).params["data_dir"]
        == Path("/var/lib") / directives(UNIT)["StateDirectory"][0]
    )
