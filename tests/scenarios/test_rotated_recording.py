"""A run on two serial ports with many short recording files: each file replays alone, and all replay in sequence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from agent.core.events import RunStart
from agent.core.pipeline import Pipeline
from agent.recording.reading import RecordingReader
from tests.scenarios.processes import ROOT, fieldcal, interrupt, recordings, results, started, wait_until

CONFIG = """
[gateway]
site = "test"
name = "rotation"
[[devices]]
name = "mems"
driver = "serial-csv"
options = {{ port = "{link}-sensor", rate_hz = 1000, axes = 3, sequence = true, unit = "count" }}
[[devices]]
name = "reference"
driver = "serial-csv"
options = {{ port = "{link}-reference", rate_hz = 1000, axes = 1, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "mems"
prior = {{ sensitivity = 26105 }}
reference = "reference"
poses = [
  {{ start_s = 3, stop_s = 13, theta_deg = 35, alpha_deg = 0 }},
  {{ start_s = 16, stop_s = 26, theta_deg = 35, alpha_deg = 30 }},
  {{ start_s = 29, stop_s = 39, theta_deg = 35, alpha_deg = 120 }},
]
poses_repeat_s = 52
[recording]
rotate_s = 11
[zenoh]
enabled = false
"""


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("rotation")
    link, data_dir = directory / "port", directory / "data"
    config = directory / "config.toml"
    config.write_text(CONFIG.format(link=link))
    with (
        started("simulate", "--preset", "plain", "--link", link, output=directory / "simulate"),
        started("run", config, "--data-dir", data_dir, output=directory / "run") as agent,
    ):
        wait_until(lambda: results(data_dir, "calibration"), 170, "a calibration")  # the bench repeats its positions
        interrupt(agent)
    return data_dir


@pytest.mark.slow
def test_the_chain_and_each_file_alone_replay_bit_for_bit(data_dir: Path) -> None:
    files = recordings(data_dir)
    assert len(files) >= 4
    for group in (files, *([file] for file in files)):
        replayed = fieldcal("replay", *group, "--json", "-")
        assert replayed.returncode == 0, replayed.stdout + replayed.stderr
        assert json.loads(replayed.stdout)["equal"] is True
    whole = json.loads(fieldcal("replay", *files, "--json", "-").stdout)
    # One calibration of three windows, as a rule. A window that lost samples comes in parts, and each may give one.
    assert len(whole["calibrations"]) == len(results(data_dir, "calibration")) >= 1
    assert len(whole["windows"]) == len(results(data_dir, "window")) >= 3


@pytest.mark.thorough
def test_replay_gives_the_same_on_one_core(data_dir: Path) -> None:
    files = recordings(data_dir)
    script = "import os, sys; os.sched_setaffinity(0, {0}); from agent.__main__ import main; main()"
    command = [sys.executable, "-c", script, "replay", *map(str, files), "--json", "-"]
    # Without the entry point's setting of one thread, BLAS would split the sums between threads and change their bits.
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    pinned = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert json.loads(pinned.stdout)["calibrations"] == json.loads(
        fieldcal("replay", *files, "--json", "-").stdout
    )["calibrations"]  # fmt: skip


def test_restored_from_its_snapshot_at_every_event_it_goes_on_alike(data_dir: Path) -> None:
    pipeline: Pipeline | None = None
    config_json, compared, given = "", 0, 0
    for file in recordings(data_dir):
        for step in RecordingReader(file).steps():
            if isinstance(step.event, RunStart):
                config_json = step.event.config_json
                if pipeline is None:
                    pipeline = Pipeline.restore(config_json, step.event.snapshot)
                else:
                    assert pipeline.snapshot() == step.event.snapshot
            assert pipeline is not None
            twin = Pipeline.restore(config_json, pipeline.snapshot())
            expected, got = pipeline.step(step.event), twin.step(step.event)
            assert got == expected
            assert twin.snapshot() == pipeline.snapshot()
            compared, given = compared + 1, given + len(expected)
    assert compared > 150
    assert given >= 6  # three windows, a calibration, statuses


def test_audit_passes_and_names_a_changed_byte(data_dir: Path, tmp_path: Path) -> None:
    files = recordings(data_dir)
    assert fieldcal("audit", *files).returncode == 0
    original = files[1].read_bytes()
    for place in (0, 100, len(original) // 2, len(original) - 200, len(original) - 1):
        changed = tmp_path / files[1].name
        changed.write_bytes(original[:place] + bytes([original[place] ^ 0x10]) + original[place + 1 :])
        audited = fieldcal("audit", changed)
        assert audited.returncode == 3, (place, audited.stdout)
        assert "Traceback" not in audited.stderr
