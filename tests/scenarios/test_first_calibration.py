"""From plugged devices to a report and a certificate: init, check, run, each as a process.

The run has many short recording files: each replays alone, and all replay in sequence.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.core.events import RunStart
from agent.core.pipeline import Pipeline
from agent.recording.reading import RecordingReader
from hw.virtual.bench import Bench
from hw.virtual.live import LiveBench
from hw.virtual.presets import COUNTS_PER_MPS2, PRESETS
from tests.scenarios.processes import ROOT, fieldcal, interrupt, recordings, results, started, wait_until
from tests.scenarios.umockdev_site import UmockdevSite, absence
from tests.unit.test_certificate_stating import entries

THROUGH_S = 100.0  # four positions take 52 s; where a busy machine lost samples, one round more
ROTATE_S = 11
ABSENCE = absence()
TODAY = datetime.now(UTC).date().isoformat()
DATES = {f"dates.{name}": TODAY for name in ("begun", "ended", "issued")}
STATED = [
    f"--state={name}={DATES.get(name, value)}" for name, value in entries().items() if not name.startswith("decision")
]


@dataclass(frozen=True)
class First:
    """What a newcomer has after the first calibration: the data directory, and what the program has said."""

    data_dir: Path
    output: str


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> First:
    """Two serial ports, `init`, `check` and a run to the first calibration, with a recording file each ROTATE_S."""
    directory = tmp_path_factory.mktemp("first")
    config, data_dir, bench = directory / "gateway.toml", directory / "data", directory / "bench"
    served, output = directory / "served", directory / "output"
    with started("simulate", "--preset", "plain", "--link", bench, output=served):
        wait_until(lambda: "reference" in served.read_text(), 60, "the ports")
        done = fieldcal(
            "init", config, "--sensor-port", f"{bench}-sensor", "--reference-port", f"{bench}-reference",
            "--theta-deg", "35", "--alpha-deg", "0,30,120,210", "--sensitivity", f"{COUNTS_PER_MPS2:.6g}",
            "--site", "bench", "--gateway", "first",
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        assert f"fieldcal check {config}" in done.stdout, "what to do next"
        written, times = re.subn(r"(?m)^.*\brotate_s = .*$", f"rotate_s = {ROTATE_S}", config.read_text())
        assert times == 1
        config.write_text(written)
        assert run_cli(["check", str(config)]) == 0
        with started("run", config, "--data-dir", data_dir, output=output) as process:
            wait_until(
                lambda: results(data_dir, "calibration") or process.poll() is not None,
                THROUGH_S,
                "a calibration",
                every_s=0.5,
            )
            interrupt(process)
        assert process.returncode == 0, output.read_text()
    return First(data_dir, output.read_text())


@pytest.mark.slow
def test_from_plugged_devices_to_a_report(first: First, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the figures need the extra `report`")
    data_dir = first.data_dir
    steps = [line for line in first.output.splitlines() if line.startswith("sensor: next: ")]
    begin = "turn the sensor to theta 35 deg, alpha 0 deg and stay 20 s (positions used: 0 of 4)"
    assert steps[0] == f"sensor: next: {begin}"
    assert steps[-1].startswith("sensor: next: nothing has to be done")
    assert all(one != other for one, other in pairwise(steps)), "only when it changes"
    assert run_cli(["report", str(data_dir), "-o", str(tmp_path / "report")]) == 0
    assert (tmp_path / "report" / "report.html").stat().st_size > 100_000
    done = fieldcal("certificate", data_dir, *STATED, "-o", tmp_path / "certificate")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "certificate" / "certificate.pdf").stat().st_size > 10_000
    last, true = results(data_dir, "calibration")[-1], Bench(PRESETS["plain"](1), 1).truth
    assert np.abs(np.array(last["sensitivity"]) - true.sensitivity).max() < 0.005 * COUNTS_PER_MPS2
    assert all(last["determined"])
    reported = json.loads((tmp_path / "report" / "report.json").read_text())
    assert reported["sensor"] == "sensor"


@pytest.mark.slow
def test_the_chain_and_each_file_alone_replay_bit_for_bit(first: First, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(path) for path in recordings(first.data_dir)]
    assert len(files) >= 4
    capsys.readouterr()
    told = {}
    for group in (files, *([file] for file in files)):
        assert run_cli(["replay", *group, "--json", "-"]) == 0
        told[tuple(group)] = json.loads(capsys.readouterr().out)
        assert told[tuple(group)]["equal"] is True
    whole = told[tuple(files)]
    # One calibration of three windows, as a rule. A window that lost samples comes in parts, and each may give one.
    assert len(whole["calibrations"]) == len(results(first.data_dir, "calibration")) >= 1
    assert len(whole["windows"]) == len(results(first.data_dir, "window")) >= 3


@pytest.mark.thorough
def test_replay_gives_the_same_on_one_core(first: First) -> None:
    files = recordings(first.data_dir)
    script = "import os, sys; os.sched_setaffinity(0, {0}); from agent.__main__ import main; main()"
    command = [sys.executable, "-c", script, "replay", *map(str, files), "--json", "-"]
    # Without the entry point's setting of one thread, BLAS would split the sums between threads and change their bits.
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    pinned = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert json.loads(pinned.stdout)["calibrations"] == json.loads(
        fieldcal("replay", *files, "--json", "-").stdout
    )["calibrations"]  # fmt: skip


@pytest.mark.slow
def test_restored_from_its_snapshot_at_every_tenth_event_it_goes_on_alike(first: First) -> None:
    pipeline: Pipeline | None = None
    twin: Pipeline
    config_json, compared, given = "", 0, 0
    for file in recordings(first.data_dir):
        for step in RecordingReader(file).steps():
            if isinstance(step.event, RunStart):
                config_json = step.event.config_json
                if pipeline is None:
                    pipeline = Pipeline.restore(config_json, step.event.snapshot)
                else:
                    assert pipeline.snapshot() == step.event.snapshot
            assert pipeline is not None
            if compared % 10 == 0:
                twin = Pipeline.restore(config_json, pipeline.snapshot())
            expected, got = pipeline.step(step.event), twin.step(step.event)
            assert got == expected
            compared, given = compared + 1, given + len(expected)
            assert compared % 10 or twin.snapshot() == pipeline.snapshot()
    assert compared > 150
    assert given >= 6  # three windows, a calibration, statuses


@pytest.mark.slow
def test_audit_passes_and_names_a_changed_byte(
    first: First, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = recordings(first.data_dir)
    done = fieldcal("audit", *files)
    assert done.returncode == 0, done.stdout + done.stderr
    original = files[1].read_bytes()
    for place in (0, 100, len(original) // 2, len(original) - 200, len(original) - 1):
        changed = tmp_path / files[1].name
        changed.write_bytes(original[:place] + bytes([original[place] ^ 0x10]) + original[place + 1 :])
        assert run_cli(["audit", str(changed)]) == 3, (place, capsys.readouterr().out)


@pytest.mark.nightly
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
