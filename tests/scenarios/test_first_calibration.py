"""From plugged devices to a report and a certificate without an editor: init, check, run, each as a process."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from hw.virtual.bench import Bench
from hw.virtual.live import LiveBench
from hw.virtual.presets import COUNTS_PER_MPS2, PRESETS
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until
from tests.scenarios.umockdev_site import UmockdevSite, absence
from tests.unit.test_certificate_stating import entries

THROUGH_S = 100.0  # four positions take 52 s; where a busy machine lost samples, one round more
ABSENCE = absence()
STATED = [f"--state={name}={value}" for name, value in entries().items() if not name.startswith("decision")]


@pytest.mark.slow
def test_from_plugged_devices_to_a_report(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figures need the extra `report`")
    config, data_dir, bench = tmp_path / "gateway.toml", tmp_path / "data", tmp_path / "bench"
    served = tmp_path / "served"
    with started("simulate", "--preset", "plain", "--link", bench, output=served):
        wait_until(lambda: "reference" in served.read_text(), 60, "the ports")
        done = fieldcal(
            "init", config, "--sensor-port", f"{bench}-sensor", "--reference-port", f"{bench}-reference",
            "--theta-deg", "35", "--alpha-deg", "0,30,120,210", "--sensitivity", f"{COUNTS_PER_MPS2:.6g}",
            "--site", "bench", "--gateway", "first",
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        assert f"fieldcal check {config}" in done.stdout, "what to do next"
        assert run_cli(["check", str(config)]) == 0
        output = tmp_path / "output"
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(
                lambda: results(data_dir, "calibration") or process.poll() is not None,
                THROUGH_S,
                "a calibration",
            )
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    steps = [line for line in output.read_text().splitlines() if line.startswith("sensor: next: ")]
    first = "turn the sensor to theta 35 deg, alpha 0 deg and stay 20 s (positions used: 0 of 4)"
    assert steps[0] == f"sensor: next: {first}"
    assert steps[-1].startswith("sensor: next: nothing has to be done")
    assert all(one != other for one, other in pairwise(steps)), "only when it changes"
    done = fieldcal("report", data_dir, "-o", tmp_path / "report")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "report" / "report.html").stat().st_size > 100_000
    done = fieldcal("certificate", data_dir, *STATED, "-o", tmp_path / "certificate")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "certificate" / "certificate.pdf").stat().st_size > 10_000
    last, true = results(data_dir, "calibration")[-1], Bench(PRESETS["plain"](1), 1).truth
    assert np.abs(np.array(last["sensitivity"]) - true.sensitivity).max() < 0.005 * COUNTS_PER_MPS2
    assert all(last["determined"])
    reported = json.loads((tmp_path / "report" / "report.json").read_text())
    assert reported["sensor"] == "sensor"


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.skipif(ABSENCE is not None, reason=str(ABSENCE))
def test_a_chip_that_the_probe_finds_to_a_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ADXL355 on an I2C bus of libumockdev: `init` finds it without an option of its own."""
    pytest.importorskip("matplotlib", reason="the certificate needs the extra `report`")
    preset = PRESETS["plain"](1)
    # At 125 Hz no FIFO of 32 samples overflows while a machine under load runs other processes.
    slow = replace(preset.sensor, clock=replace(preset.sensor.clock, nominal_rate_hz=125.0))
    data_dir, config, output = tmp_path / "data", tmp_path / "gateway.toml", tmp_path / "output"
    with LiveBench(replace(preset, sensor=slow), 1) as live, UmockdevSite({"/dev/i2c-1": live.bus}) as site:
        for name, value in site.environment.items():
            monkeypatch.setenv(name, value)
        lines = [f"--reference-option={option}" for option in ("rate_hz=1000", "axes=1", "sequence=true")]
        done = fieldcal(
            "init", config, "--sensor-option", "rate_hz=125", "--reference-port", live.port.path, *lines,
            "--theta-deg", "35", "--alpha-deg", "0,30,120,210",
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        assert "probe: ADXL355" in config.read_text()
        assert fieldcal("check", config).returncode == 0
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(lambda: results(data_dir, "calibration") or process.poll() is not None, THROUGH_S, "S and Q")
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    monkeypatch.undo()
    done = fieldcal("certificate", data_dir, *STATED, "-o", tmp_path / "certificate")
    assert (done.returncode, done.stderr) == (0, "")
    last, true = results(data_dir, "calibration")[-1], live.bench.truth
    u = np.reshape(last["standard_uncertainty"][:9], (3, 3))
    assert (np.abs(np.array(last["sensitivity"]) - true.sensitivity) < 4.0 * u).all()
    assert u.max() < 0.03 * COUNTS_PER_MPS2
    assert all(last["determined"])
