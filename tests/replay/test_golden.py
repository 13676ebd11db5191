"""Every golden recording holds the results of the engine that made it, and this engine gives them again, bit for bit.

An earlier engine is built from the history of the repository (deploy/engines/earlier.py). Its test is skipped where the
history is not there, as in a shallow clone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from mcap.reader import NonSeekingReader

from agent.audit.engines import as_if_own
from agent.audit.replaying import Replayer
from agent.config import recorded_config
from agent.core.events import CalibrationUpdate, DeviceChange, WindowReport
from agent.core.pipeline import Pipeline
from agent.delivery.history import History
from agent.delivery.store import Store
from agent.engine.process import EngineProcess, EngineResults
from agent.engine.wheel import read_wheel
from agent.recording.comparison import differences
from agent.recording.fingerprint import fingerprint
from agent.recording.messages import decode
from agent.recording.reading import RecordingReader
from tests.replay.golden_files import FORMATS, GOLDEN, PRESENT, RECORDING, STATE, config_of, engine_wheel, start_of

# Relative, where the golden recording was made on another CPU: kernels of other CPUs round differently, which a number
# that is a small difference of larger ones magnifies (6e-9 between AVX-512 and AVX2).
ELSEWHERE = 2e-8
SIGNATURE = b"\xc2\x3e\x40"  # protobuf: field 1000, 64 bytes follow
EARLIER = sorted(path for path in GOLDEN.iterdir() if path != PRESENT)
RESULTS_CHANGED = (
    f"the results of {PRESENT.name} have changed. If this is meant, raise NUMBER in agent/engine/identity.py, make the "
    "next golden recording (`python -m tests.replay.golden_files`), and say in CHANGELOG.md why results change: {}"
)


def test_results_of_the_present_engine_change_with_its_number_alone() -> None:
    assert PRESENT.exists(), f"{PRESENT} is missing: `python -m tests.replay.golden_files` makes it"
    replay = Replayer(as_if_own(Pipeline.restore), fingerprint(), ELSEWHERE).run(PRESENT / RECORDING)
    file = replay.file
    assert (file.fault, file.undecidable) == (None, 0)
    assert file.equal, RESULTS_CHANGED.format(file.refused or file.first_difference)
    assert len(replay.calibrations) >= 1
    assert len(replay.windows) >= 3


def messages(path: Path) -> Iterator[tuple[str, bytes]]:
    """Schema and bytes of every message of a recording, in order, results without their signature."""
    with open(path, "rb") as file:
        for schema, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            assert schema is not None
            data = message.data
            signed = data[-67:-64] == SIGNATURE
            yield schema.name, data[:-67] if signed else data


def is_event(schema: str) -> bool:
    return schema.endswith((".Event", ".RawBlock"))


def computed(process: EngineProcess, path: Path) -> Iterator[tuple[str, bytes]]:
    """The events of a recording, each followed by the results that the engine gives for it."""
    give = process.begin
    for schema, data in messages(path):
        if is_event(schema):
            yield schema, data
            results: EngineResults = give(schema, data)
            yield from results.messages
            give = process.step


@pytest.mark.two_cases
@pytest.mark.parametrize("directory", EARLIER, ids=lambda path: path.name)
def test_an_earlier_engine_gives_the_results_that_it_recorded(directory: Path) -> None:
    engine, wheel = engine_wheel(directory)
    assert hashlib.sha256(wheel).hexdigest() == engine.sha256, (
        "agent/engine/known.json does not know this wheel: `python -m deploy.engines.earlier --write` adds it"
    )
    recorded = list(messages(directory / RECORDING))
    assert sum(schema == "fieldcal.v1.Calibration" for schema, _ in recorded) >= 1
    with EngineProcess(read_wheel(directory.name, wheel)) as process:
        found = list(computed(process, directory / RECORDING))
    if start_of(directory / RECORDING).fingerprint == fingerprint():
        assert found == recorded
    for (schema, data), (name, held) in zip(found, recorded, strict=True):
        assert schema == name
        if not is_event(schema):
            expected, result = (msgspec.to_builtins(decode(schema, one)[1]) for one in (held, data))
            assert list(differences(expected, result, ELSEWHERE)) == []


@pytest.mark.parametrize("directory", FORMATS, ids=lambda path: path.name)
def test_a_state_of_a_released_format_is_brought_up_to_date(directory: Path, tmp_path: Path) -> None:
    (tmp_path / STATE).write_bytes((directory / STATE).read_bytes())
    store = Store(tmp_path, 0)
    assert store.set_aside is None
    config = recorded_config(config_of(directory / RECORDING))
    (sensor,) = [channel.sensor for channel in config.channels]
    with History(store.path) as history:
        in_force = history.in_force(sensor)
    kept = {memory.identity: memory.state for memory in store.states if memory.sensor == sensor}
    store.close()
    assert in_force is not None
    pipeline = Pipeline.begin(config, "later", 0, store.last_sequence(), {sensor: kept})
    events = (step.event for step in RecordingReader(directory / RECORDING).steps())
    opened = next(e for e in events if isinstance(e, DeviceChange) and e.device == sensor)
    (again,) = [result for result in pipeline.step(opened) if isinstance(result, CalibrationUpdate)]
    assert again.sensitivity == in_force.fields["sensitivity"]
    assert again.offset == in_force.fields["offset"]
    assert again.covariance == in_force.fields["covariance"]
    results = [result for event in events for result in pipeline.step(event)]
    windows = [result for result in results if isinstance(result, WindowReport)]
    assert [window.reason for window in windows if not window.used] == []  # the same windows as those before
    assert len(windows) >= 1
