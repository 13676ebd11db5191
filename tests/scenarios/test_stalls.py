"""What would stop all threads of a run: modules that are loaded late, and a garbage collector with many objects."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from agent.acquisition.service import Service
from agent.acquisition.stalls import few_objects
from agent.config import Config, parse_config
from agent.terminal.watch import RunView
from tests.scenarios.processes import ROOT, wait_until
from tests.unit.recorded_bench import record

# Imports the service, then steps and records events until windows were used, and prints the modules loaded meanwhile.
STEPS = """
import json, sys
from pathlib import Path
import agent.acquisition.service
from agent.config import recorded_config
from agent.core.events import CalibrationUpdate, WindowReport
from agent.core.pipeline import Pipeline
from agent.recording.reading import RecordingReader
from agent.recording.writer import Recorder

start, *events = (step.event for step in RecordingReader(Path(sys.argv[1])).steps())
pipeline = Pipeline.begin(recorded_config(start.config_json), "run", 0, 0, {})
recorder = Recorder(Path(sys.argv[2]), ["mems", "reference"], ["mems"])
recorder.record(0, start, [])
before = set(sys.modules)
used = 0
for number, event in enumerate(events, start=1):
    results = pipeline.step(event)
    pipeline.memories(results)
    recorder.record(number, event, results)
    used += sum(isinstance(result, WindowReport) and result.used for result in results)
pipeline.snapshot()
recorder.close()
print(json.dumps({"used": used, "late": sorted(set(sys.modules) - before)}))
"""


def test_all_that_windows_need_is_loaded_with_the_service(tmp_path: Path) -> None:
    record(tmp_path / "bench", 32.0)
    (recording,) = (tmp_path / "bench").glob("*.mcap")
    (tmp_path / "again").mkdir()
    command = [sys.executable, "-c", STEPS, str(recording), str(tmp_path / "again")]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(told.stdout) == {"used": 2, "late": []}


STANDS = {"start_s": 0, "stop_s": 3600, "gravity_mps2": [0, 0, 9.81]}
FEW = 10_000  # objects that the collector examines in 2 ms; a run makes about 700, the modules have 50,000


@pytest.mark.thorough
def test_the_collector_walks_through_what_the_run_made_only(tmp_path: Path) -> None:
    options = {"port": str(tmp_path / "absent"), "rate_hz": 100, "axes": 3, "unit": "m/s2"}
    config = parse_config(
        {
            "gateway": {"site": "test", "name": "stalls"},
            "devices": [{"name": "imu", "driver": "serial-csv", "options": options}],
            "channels": [{"sensor": "imu", "prior": {}, "poses": [STANDS]}],
            "zenoh": {"enabled": False},
        },
        "test",
    )
    gc.unfreeze()  # what tests/conftest.py froze
    try:
        _run_and_look(config, tmp_path)
    finally:
        gc.freeze()


def _run_and_look(config: Config, tmp_path: Path) -> None:
    assert len(gc.get_objects()) > 4 * FEW
    with RunView(config, "test", None) as watch:
        service = Service(config, tmp_path / "data", watch)
        runner = threading.Thread(target=service.run, args=(None,))
        runner.start()
        try:
            # Not by the objects themselves: a list of them keeps cursors alive, and then SQLite refuses to commit.
            wait_until(gc.get_freeze_count, 60, "the collector has few objects")
            assert len(gc.get_objects()) < FEW
        finally:
            service.stop()
            runner.join(60)
    assert not runner.is_alive()
    assert len(gc.get_objects()) > 4 * FEW


def test_what_was_frozen_before_stays_so() -> None:
    assert gc.get_freeze_count() > 4 * FEW
    with few_objects():
        pass
    assert gc.get_freeze_count() > 4 * FEW
