"""A driver with a bug: the agent lives, the other devices go on, and the recording can be read."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from agent.acquisition import reader
from agent.acquisition.service import Service
from agent.audit.engines import Engines
from agent.cli.audit import run_audit
from agent.cli.given import recordings_of
from agent.cli.main import run_cli
from agent.config import Config, parse_config
from agent.core.events import DeviceChange, Event, Gap
from agent.core.pipeline import Pipeline
from agent.recording.reading import RecordingReader
from agent.setup import device_checks
from agent.terminal.watch import RunView
from hw.block import BlockFlags, SampleBlock
from tests.scenarios.processes import ROOT, fieldcal, recordings, wait_until
from tests.unit.buggy_driver import BUGS, IN_BLOCKS, NOT_FIRST, install

STANDS = {"start_s": 0, "stop_s": 3600, "gravity_mps2": [0, 0, 9.81]}
TOGETHER = 24  # devices with a bug in one run


def name_of(bug: str) -> str:
    """The device that has this bug."""
    return f"bug-{BUGS.index(bug)}" if bug in BUGS else "bug"


def configuration(bugs: Sequence[str]) -> Config:
    """A device for each bug, and a good one; each is the sensor of a channel."""
    options = {name_of(bug): {"bug": bug} for bug in bugs} | {"good": {}}
    return parse_config(
        {
            "gateway": {"site": "test", "name": "drivers"},
            "devices": [{"name": name, "driver": "buggy", "options": of} for name, of in options.items()],
            "channels": [{"sensor": name, "prior": {}, "poses": [STANDS]} for name in options],
            "recording": {"flush_s": 0.2},
            "zenoh": {"enabled": False},
        },
        "test",
    )


@dataclass
class Run:
    """What a run left. `raised`: what ended the agent; `ended`: it stopped when it was asked to.

    `stopped_s`: seconds from the request to the end. `events`: all that were recorded. `audit`: the status with which
    `fieldcal audit` ends.
    """

    data_dir: Path
    raised: list[BaseException] = field(default_factory=list)
    ended: bool = False
    stopped_s: float = 0.0
    events: list[Event] = field(default_factory=list)
    audit: int = -1

    def look(self) -> Run:
        """Read the recordings as they are now."""
        self.events = [step.event for file in recordings(self.data_dir) for step in RecordingReader(file).steps()]
        return self

    def of(self, device: str) -> list[Event]:
        """The events of one device."""
        return [event for event in self.events if getattr(event, "device", "") == device]


def run(config: Config, data_dir: Path, enough: Callable[[Run], bool], timeout_s: float = 60.0) -> Run:
    """Run the agent on these devices until `enough`, at most `timeout_s`."""
    found = Run(data_dir)
    with RunView(config, "test", None) as watch:
        service = Service(config, data_dir, watch)

        def guarded() -> None:
            try:
                service.run(None)
                found.ended = True
            except BaseException as error:
                found.raised.append(error)

        runner = threading.Thread(target=guarded)
        runner.start()
        try:
            # To read all that is recorded again and again takes more processor time than the agent does.
            wait_until(lambda: not runner.is_alive() or enough(found.look()), timeout_s, "enough", every_s=0.6)
        finally:
            asked_s = time.monotonic()
            service.stop()
            runner.join(60)
            found.stopped_s = time.monotonic() - asked_s
    assert not runner.is_alive()
    found.audit = run_audit(recordings_of([data_dir]), Engines(Pipeline.restore), as_json=False)
    return found.look()


def blocks_after(events: Sequence[Event], is_last: Callable[[Event], bool]) -> list[SampleBlock]:
    """The blocks after the last event that is such a one."""
    last = max((i for i, event in enumerate(events) if is_last(event)), default=-1)
    return [event for event in events[last + 1 :] if isinstance(event, SampleBlock)] if last >= 0 else []


def recovered(found: Run, device: str) -> list[SampleBlock]:
    """The blocks of a device after its bug showed the last time."""
    return blocks_after(found.of(device), lambda event: isinstance(event, DeviceChange) and event.state == "lost")


@pytest.fixture(scope="module", autouse=True)
def plug_in(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    site = tmp_path_factory.mktemp("site")
    install(site)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        patch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{site}")
        patch.setattr("hw.sensor.entry_points", cache(entry_points))  # 15 ms for each device with a plug-in
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Run]:
    """The run in which the agent met a bug, with TOGETHER - 1 other ones."""

    @cache
    def run_of(group: int) -> Run:
        bugs = BUGS[TOGETHER * group : TOGETHER * (group + 1)]

        def enough(of: Run) -> bool:
            return all(len(recovered(of, name_of(bug))) > 2 for bug in bugs)

        return run(configuration(bugs), tmp_path_factory.mktemp("data"), enough)

    return lambda bug: run_of(BUGS.index(bug) // TOGETHER)


@pytest.mark.one_case
@pytest.mark.parametrize("bug", BUGS)
def test_a_bug_costs_what_it_breaks_and_nothing_else(runs: Callable[[str], Run], bug: str) -> None:
    found = runs(bug)
    assert found.raised == []
    assert found.ended
    assert found.audit == 0
    events = found.of(name_of(bug))
    told = [event.message for event in events if isinstance(event, DeviceChange) and event.state == "lost"]
    assert told
    again = recovered(found, name_of(bug))
    assert again[0].flags & BlockFlags.RESTART
    assert {block.n for block in again} == {10}
    good = [event for event in found.of("good") if not isinstance(event, SampleBlock)]
    assert [event.state for event in good if isinstance(event, DeviceChange)] == ["open"]
    assert len(good) == 1
    whole = [event for event in found.of("good") if isinstance(event, SampleBlock)]
    assert [block.first_index for block in whole] == [10 * k for k in range(len(whole))]


@pytest.mark.slow
@pytest.mark.parametrize("bug", [*IN_BLOCKS, *NOT_FIRST])
def test_a_bad_block_is_a_drop_with_its_reason(runs: Callable[[str], Run], bug: str) -> None:
    gaps = [event for event in runs(bug).of(name_of(bug)) if isinstance(event, Gap)]
    assert [(gap.dropped, gap.unit) for gap in gaps] == [(1, "blocks")] * 2
    assert all(gap.reason for gap in gaps)


def one(bug: str, times: int = 2) -> Config:
    """One device with a bug and a good one."""
    options = {"bug": bug, "times": times}
    config = configuration([bug])
    return config.model_copy(
        update={"devices": (config.devices[0].model_copy(update={"options": options}), config.devices[1])}
    )


def losses(found: Run, bug: str) -> list[str]:
    """What the losses of a device were told as."""
    return [e.message for e in found.of(name_of(bug)) if isinstance(e, DeviceChange) and e.state == "lost"]


@pytest.mark.slow
def test_ten_faults_in_a_row_name_the_driver_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(reader, "BACK_OFF_S", (0.01, 0.02))
    bug = "a negative count"
    with caplog.at_level(logging.INFO, "fieldcal"):
        found = run(one(bug, times=25), tmp_path, lambda found: len(recovered(found, name_of(bug))) > 2)
    told = losses(found, bug)
    assert len(told) == 2, "the same fault is told once, and once more after ten"
    assert "tests.unit.buggy_driver.Buggy: a block that cannot be used: burst_count begins with -1" in told[0]
    assert "10 times in a row. Use another version of the driver, and tell its author" in told[1]
    states = [record.getMessage() for record in caplog.records if record.getMessage().startswith("degraded")]
    assert any(f"{name_of(bug)} is lost: {told[1]}" in state for state in states), "the status says it"
    gaps = [event for event in found.of(name_of(bug)) if isinstance(event, Gap)]
    assert sum(gap.dropped for gap in gaps) == 25
    opened = [e for e in found.of(name_of(bug)) if isinstance(e, DeviceChange) and e.state == "open"]
    assert len(opened) == 2, "one before the first fault, one when the driver worked"
    assert found.audit == 0


HANGS = ["open", "read_block", "close"]


@pytest.mark.one_case
@pytest.mark.parametrize("method", HANGS)
def test_a_driver_that_does_not_return_is_named_and_the_agent_ends_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setattr(reader, "HANGS_S", 0.5)
    bug = f"{method}: does not return"
    config = one(bug, times=1)

    def enough(found: Run) -> bool:
        after = blocks_after(found.events, lambda e: isinstance(e, DeviceChange) and "has not returned" in e.message)
        return any(block.device == "good" for block in after)

    found = run(config, tmp_path, enough)
    assert found.ended
    assert found.stopped_s < 30.0  # two seconds on a quiet machine; the driver never returns
    assert found.audit == 0
    assert f"Buggy: it has not returned from {method} for 0.5 s" in losses(found, bug)[-1]


@pytest.mark.slow
def test_a_driver_that_returns_late_is_opened_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "HANGS_S", 0.5)
    bug = "read_block: returns after two seconds"
    found = run(one(bug, times=1), tmp_path, lambda found: len(recovered(found, name_of(bug))) > 2)
    assert "has not returned from read_block" in losses(found, bug)[0]
    assert "returned from read_block, but after more than 0.5 s" in losses(found, bug)[1]
    assert recovered(found, name_of(bug))[0].flags & BlockFlags.RESTART
    assert found.audit == 0


@pytest.mark.slow
def test_arrays_that_the_driver_uses_again_are_recorded_as_they_were(tmp_path: Path) -> None:
    bug = "one array for all blocks"
    found = run(one(bug), tmp_path, lambda found: len(found.of(name_of(bug))) > 6)
    blocks = [event for event in found.of(name_of(bug)) if isinstance(event, SampleBlock)]
    assert [int(block.indications[0, 0]) for block in blocks] == list(range(len(blocks)))
    assert found.audit == 0


@pytest.mark.thorough
def test_a_flood_of_blocks_takes_nothing_from_another_device(tmp_path: Path) -> None:
    bug = "a flood"
    found = run(one(bug), tmp_path, lambda found: sum(isinstance(e, SampleBlock) for e in found.of("good")) > 20)
    whole = [event for event in found.of("good") if isinstance(event, SampleBlock)]
    assert [block.first_index for block in whole] == [10 * k for k in range(len(whole))]
    assert not any(isinstance(event, Gap) for event in found.of("good"))
    flood = [event for event in found.of(name_of(bug)) if isinstance(event, SampleBlock)]
    lasted_s = (flood[-1].t_monotonic_ns - flood[0].t_monotonic_ns) * 1e-9
    assert flood[-1].first_index <= lasted_s / reader.SHORTEST_CALL_S + 1
    assert found.audit == 0


def written(tmp_path: Path, bug: str) -> Path:
    """The configuration of one device with a bug and a good one, as a file."""
    path = tmp_path / "config.toml"
    devices = ", ".join(
        f"{{ name = {json.dumps(name)}, driver = 'buggy', options = {{ bug = {json.dumps(of)}, times = 1000000 }} }}"
        for name, of in (("imu", bug), ("good", ""))
    )
    channels = "{ sensor = 'imu', prior = {} }, { sensor = 'good', prior = {} }"
    path.write_text(f"zenoh = {{ enabled = false }}\ndevices = [{devices}]\nchannels = [{channels}]\n")
    return path


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("bug", "says"),
    [
        ("counts without a sign", "a block that cannot be used: indications is an array of uint32"),
        ("SystemExit", "SystemExit: 3"),
        ("nothing from open", "open returned a NoneType, not a DeviceInfo"),
        ("it cannot be made", "TypeError: unsupported operand"),
        ("read_block: does not return", "it does not return"),
        ("close: KeyboardInterrupt", "KeyboardInterrupt"),
    ],
)
def test_doctor_names_a_driver_with_a_bug(
    tmp_path: Path, bug: str, says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_checks, "RETURNS_S", 1.0)
    path = written(tmp_path, bug)
    assert run_cli(["doctor", str(path), "--data-dir", str(tmp_path), "--measure", "1", "--json", "-"]) == 3
    found = [f for f in json.loads(capsys.readouterr().out)["findings"] if f["check"] == "throughput"]
    assert found[0]["says"].startswith(f"imu: fault in the driver 'buggy': {says}")
    assert "author" in found[0]["remedy"]
    assert found[1]["says"].startswith("good: ")
    assert "samples a second" in found[1]["says"]


@pytest.mark.thorough
def test_a_driver_that_cannot_be_made_is_a_fault_of_the_configuration(tmp_path: Path) -> None:
    done = fieldcal("run", written(tmp_path, "it cannot be made"), "--data-dir", tmp_path / "data")
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "fieldcal run: imu: fault in the driver 'buggy': it cannot be made: TypeError: unsupported operand type(s) for "
        "/: 'str' and 'int'"
    ]
