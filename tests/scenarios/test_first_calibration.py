"""From plugged devices to a report and a certificate without an editor: init, check, run, each as a process."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from hw.virtual.bench import Bench
from hw.virtual.presets import COUNTS_PER_MPS2, PRESETS
from tests.scenarios.processes import fieldcal, interrupt, results, started, wait_until
from tests.unit.test_certificate_stating import entries

THROUGH_S = 100.0  # four positions take 52 s; where a busy machine lost samples, one round more
STATED = [f"--state={name}={value}" for name, value in entries().items() if not name.startswith("decision")]


@pytest.mark.slow
def test_from_plugged_devices_to_a_report(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figures need the extra `report`")
    config, data_dir, bench = tmp_path / "gateway.toml", tmp_path / "data", tmp_path / "bench"
    served = tmp_path / "served"
    with started("simulate", "--preset", "plain", "--link", bench, output=served):
        wait_until(lambda: "reference" in served.read_text(), 20, "the ports")
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
    assert (
        steps[0]
        == "sensor: next: turn the sensor to theta 35 deg, alpha 0 deg and stay 20 s (positions used: 0 of 4)"
    )
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
