"""The loop with which the agent is compared: it reads two devices and records them. Same drivers, same recorder.

python -m benchmarks.bare_loop CONFIG DATA_DIR SECONDS
"""

from __future__ import annotations

import os
import sys

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import time
from pathlib import Path

from agent.acquisition.reader import DeviceReader, EventQueue
from agent.config import load_config
from agent.core.events import RunStart
from agent.recording.writer import Recorder
from hw.sensor import boot_id, load_driver


def main() -> None:
    """Read and record for SECONDS."""
    config = load_config(Path(sys.argv[1]))
    data_dir = Path(sys.argv[2])
    data_dir.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(data_dir, [device.name for device in config.devices], [])
    events = EventQueue(len(config.devices))
    for device in config.devices:
        driver = load_driver(device.driver)
        DeviceReader(
            device.name, driver(device.name, driver.options_model.model_validate(device.options)), events
        ).start()
    now_ns = time.monotonic_ns()
    start = RunStart(
        run_id="bare", site="", gateway="", boot_id=boot_id(), t_monotonic_ns=now_ns, t_utc_ns=time.time_ns(),
        config_json="", versions={}, fingerprint={}, snapshot=b"", file_sequence=1, event_sequence=0,
    )  # fmt: skip
    recorder.record(0, start, [])
    sequence = 0
    end_s = time.monotonic() + float(sys.argv[3])
    flush_s = time.monotonic() + config.recording.flush_s
    while time.monotonic() < end_s:
        event = events.get(0.2)
        if event is not None:
            sequence += 1
            recorder.record(sequence, event, [])
        if time.monotonic() > flush_s:
            recorder.sync()
            flush_s += config.recording.flush_s
    recorder.close()


main()
