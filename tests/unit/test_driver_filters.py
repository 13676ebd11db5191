"""Filters that drivers state: divided out on-line as if the configuration stated them; restarts, recordings, faults."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import Config
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import Estimation
from agent.core.events import CalibrationUpdate, DeviceChange, Event, StatusChange
from agent.core.kept import OTHER_FILTERS, keep, take_up
from agent.core.snapshot import pack
from agent.recording.reading import RecordingReader
from benchmarks.online import chip
from benchmarks.online.life import Gateway
from benchmarks.online.node import Node, Stated, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from hw import adxl355_registers
from hw.block import DeviceInfo
from hw.virtual import adxl355_twin
from hw.virtual.building import Building
from tests.unit.test_known_online import NEAR, NEAR_TEXT, assert_goes_on, filtered, stating
from tests.unit.test_response_online import SEED

WINDOWS = 4
NEARLY = NEAR_TEXT[0].replace("corner_hz=14", "corner_hz=14.1")
STATED = {"sensor": tuple(NEAR_TEXT), "reference": ("flat",)}


@cache
def drawn() -> Node:
    return node(SEED, all_axes=True, stated=Stated(lag_s=0.01), timing=Timing(20.0, 60.0, WINDOWS))


def building(filters: dict[str, tuple[str, ...]]) -> Building:
    """Its sensor has the filter NEAR; its drivers state these ones."""
    found = filtered(drawn(), "sensor", NEAR)
    p = found.parameters
    told = {role: replace(getattr(p, role), filters=lines) for role, lines in filters.items()}
    return Building(replace(p, **told), SEED)


def events(filters: dict[str, tuple[str, ...]], *, backwards: bool = False) -> list[Event]:
    """The visits of `building`; `backwards`: the reference is opened first."""
    found = list(visits(building(filters), range(WINDOWS)))
    return [found[1], found[0], *found[2:]] if backwards else found


def calibrations(config: Config, of: Iterable[Event]) -> list[CalibrationUpdate]:
    run = Run(config)
    found = [result for event in of for result in run.feed(event) if isinstance(result, CalibrationUpdate)]
    run.close()
    return found


def same(one: list[CalibrationUpdate], other: list[CalibrationUpdate]) -> bool:
    """Whether S, Q and their covariances are the same, bit for bit."""
    assert one
    return [(u.sensitivity, u.offset, u.covariance) for u in one] == [
        (u.sensitivity, u.offset, u.covariance) for u in other
    ]


@pytest.mark.one_case
@pytest.mark.parametrize("backwards", [False, True])
def test_what_drivers_state_counts_as_if_the_configuration_stated_it(*, backwards: bool) -> None:
    config = drawn().config
    by_configuration = calibrations(stating(config, prior=NEAR_TEXT, certificate=["flat"]), events({}))
    assert same(calibrations(config, events(STATED, backwards=backwards)), by_configuration)
    assert not same(calibrations(config, events({})), by_configuration)


@pytest.mark.thorough
def test_the_configuration_comes_before_the_driver() -> None:
    config = stating(drawn().config, prior=NEAR_TEXT, certificate=["flat"])
    other: dict[str, tuple[str, ...]] = {"sensor": ("lowpass corner_hz=40",), "reference": ("lowpass corner_hz=30",)}
    assert same(calibrations(config, events(other)), calibrations(config, events({})))


LATE = (62.5, 12.0, 0.003)  # by 24 ms


@pytest.mark.slow
def test_s_is_right_beside_the_filters_of_an_adxl355() -> None:
    found = chip.one((LATE, "sensor", chip.SEED))
    assert found.used >= chip.TIMING.windows
    assert not found.held
    assert np.nanmax(np.abs(found.over_u)) < 1.3  # of 12 values, U is two standard uncertainties
    assert np.abs(found.over_u_at_0hz).max() < 1.3
    assert np.abs(found.main).max() < 2e-3


@pytest.mark.thorough
def test_windows_are_held_where_nobody_states_the_filters_of_an_adxl355() -> None:
    assert chip.one((LATE, "nothing", chip.SEED)).used < chip.TIMING.windows


@pytest.mark.one_case
@pytest.mark.parametrize("cut", [1, 2, 60])  # between the openings of the devices, after them, within a window
def test_a_restored_state_goes_on_bit_for_bit(cut: int) -> None:
    assert_goes_on(drawn().config, list(events(STATED)), cut)


@pytest.mark.slow
def test_a_recording_carries_them_so_that_its_audit_gives_the_same_results(tmp_path: Path) -> None:
    path = recorded(tmp_path / "data", STATED)
    results = [result for step in RecordingReader(path).steps() for result in step.results]
    assert any(isinstance(result, CalibrationUpdate) for result in results)
    assert run_cli(["audit", str(path)]) == 0


def recorded(directory: Path, filters: dict[str, tuple[str, ...]]) -> Path:
    """A recording of the visits of `building`."""
    directory.mkdir()
    run = Run(drawn().config, directory)
    for event in events(filters):
        run.feed(event)
    run.close()
    (path,) = directory.glob("*.mcap*")
    return path


def calibrated(path: Path, *options: str) -> list[list[float]]:
    """S of `fieldcal calibrate` from both devices of a recording."""
    of = ["--sensor", path, "--columns", "group=sensor", "--reference", path, "--reference-columns", "group=reference"]
    out = path.with_suffix(".json")
    assert run_cli(["calibrate", *map(str, of), "--rotation", "1,0,0,0,1,0,0,0,1", "--json", str(out), *options]) == 0
    return json.loads(out.read_text())["sensitivity"]  # type: ignore[no-any-return]


@pytest.mark.nightly
def test_calibrate_uses_the_corner_in_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    coupled = {**STATED, "reference": ("flat", "highpass corner_hz=0.01 u_corner_pct=30")}
    with_it, without = recorded(tmp_path / "a", coupled), recorded(tmp_path / "b", STATED)
    stated = calibrated(without, "--reference-corner-hz", "0.01", "--u-reference-corner-hz", "0.003")
    capsys.readouterr()
    assert calibrated(with_it) == stated
    assert "--reference-corner-hz 0.01, as its driver states in the recording" in capsys.readouterr().err
    own = ["--reference-corner-hz", "0.008", "--u-reference-corner-hz", "0.003"]
    assert calibrated(with_it, *own) == calibrated(without, *own) != stated


@pytest.mark.thorough
def test_calibrate_uses_the_filters_in_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with_them, without = recorded(tmp_path / "a", STATED), recorded(tmp_path / "b", {})
    options = ["--sensor-filter", NEAR_TEXT[0], "--reference-filter", "flat"]
    stated = calibrated(without, *options)
    capsys.readouterr()
    assert calibrated(with_them) == stated
    assert f"--sensor-filter '{NEAR_TEXT[0]}', as its driver states in the recording" in capsys.readouterr().err
    assert calibrated(without) != stated
    own = ["--sensor-filter", NEARLY]
    assert calibrated(with_them, *own) == calibrated(without, *own, *options[2:]) != stated
    calibrated(with_them, "--plain")  # takes no filters
    csv = tmp_path / "sensor.csv"
    assert run_cli(["convert", str(with_them), "--columns", "group=sensor", "-o", str(csv)]) == 0
    assert f"calibrate with --sensor-filter '{NEAR_TEXT[0]}'" in capsys.readouterr().err


def test_check_tells_which_filters_are_used_and_who_states_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        "[[devices]]", 'name = "a"', 'driver = "adxl345"', "[devices.options]", "rate_hz = 100",
        "[[devices]]", 'name = "b"', 'driver = "serial-csv"', "[devices.options]", 'port = "/dev/b"', "rate_hz = 50",
        'filters = ["mean points=4 rate_hz=200"]',
        "[[devices]]", 'name = "c"', 'driver = "serial-csv"', "[devices.options]", 'port = "/dev/c"', "rate_hz = 50",
        "[[channels]]", 'sensor = "a"', 'reference = "b"', "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]",
        "[channels.prior]", "[channels.check_reference]", 'device = "c"',
        "[[channels]]", 'sensor = "b"', 'reference = "c"', "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]",
        "[channels.prior]", 'filters = ["flat"]', "[channels.certificate]", 'filters = ["flat u_pct=1"]',
    ]  # fmt: skip
    path = tmp_path / "site.toml"
    path.write_text("\n".join(lines) + "\n")
    assert run_cli(["check", str(path)]) == 0
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("  filters")] == [
        "  filters of a, stated by the driver adxl345: lowpass order=1 corner_hz=50 u_corner_pct=50",
        "  filters of b, stated by the driver serial-csv: mean points=4 rate_hz=200",
        "  filters of c: none stated; its response is estimated with S",
        "  filters of b, stated by prior: flat",
        "  filters of c, stated by the certificate: flat u_pct=1",
    ]
    assert run_cli(["check", str(path), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)["filters"]
    assert told[1] == {
        "sensor": "a", "device": "b", "lines": ["mean points=4 rate_hz=200"], "stated_by": "the driver serial-csv",
    }  # fmt: skip
    path.write_text("\n".join(lines).replace("mean points=4", "mean points=x") + "\n")
    assert run_cli(["check", str(path)]) == 2
    assert "devices.1.options.filters: points: 'x' is no number" in capsys.readouterr().err


class Chip(Building):
    """A building whose sensor is an ADXL355 at this rate; `told`: whether its driver names the setting of its rate."""

    def __init__(self, rate_hz: float, *, told: bool = True) -> None:
        p = drawn().building.parameters
        clock = replace(p.sensor.clock, nominal_rate_hz=rate_hz)
        sensor = replace(
            p.sensor, clock=clock, response=adxl355_twin.filters(rate_hz), filters=adxl355_registers.filters(rate_hz)
        )
        super().__init__(replace(p, sensor=sensor, reference=replace(p.reference, filters=("flat",))), SEED)
        self._settings = {"RANGE": "0x81", "FILTER": f"{rate_hz:g}"}
        self._filter_settings = ("FILTER",) if told else ()

    def infos(self) -> dict[str, DeviceInfo]:
        found = super().infos()
        sensor = replace(found["sensor"], settings=self._settings, filter_settings=self._filter_settings)
        return {**found, "sensor": sensor}


def restarted(before: Building, after: Building) -> tuple[list[bool], list[str], str]:
    """After a restart: whether the windows are used, what is told of the status, and the status at the end."""
    gateway = Gateway(drawn().config, np.zeros(12))
    gateway.feed(visits(before, range(WINDOWS)))
    assert all(report.used for report in gateway.reports)
    gateway.restart(drawn().config)
    windows, told = len(gateway.reports), len(gateway.reasons)
    gateway.feed(visits(after, range(WINDOWS, 2 * WINDOWS)))
    return [report.used for report in gateway.reports[windows:]], gateway.reasons[told:], gateway.status


@pytest.mark.thorough
def test_another_output_data_rate_at_the_next_start_is_another_filter_and_no_drift() -> None:
    used, told, status = restarted(Chip(62.5), Chip(125.0))
    assert told[0] == f"restored from the previous run; {OTHER_FILTERS}"
    assert all(used)
    assert status == "VALID"


@pytest.mark.thorough
def test_the_same_rate_at_the_next_start_is_the_same_filter_also_while_the_reference_is_not_open_yet() -> None:
    used, told, status = restarted(Chip(62.5), Chip(62.5))
    assert told[0] == "restored from the previous run"
    assert not any(OTHER_FILTERS in reason for reason in told)
    assert all(used)
    assert status == "VALID"


@pytest.mark.thorough
def test_a_device_with_another_setting_that_is_no_filter_is_another_device() -> None:
    _, told, _ = restarted(Chip(62.5, told=False), Chip(125.0, told=False))
    assert told[0].startswith("the stored calibration belongs to")


@pytest.mark.parametrize(
    ("filters", "said"),
    [
        (["lowpass corner=31"], "'corner=31': lowpass takes corner_hz=..., order=..., u_corner_pct=..."),
        (["flat"] * 9, "there are 9 filters, at most 8 are allowed"),
        (["highpass corner_hz=1"] * 2, "there are 2 high-pass filters; state one, with the corner of all together"),
        ("flat", "a list of texts is needed, one for each filter"),
        ([1.0], "a list of texts is needed, one for each filter"),
    ],
)
def test_a_statement_that_cannot_be_read_is_told_and_not_used(filters: Any, said: str) -> None:
    info = asdict(building({}).infos()["sensor"]) | {"filters": filters}
    opened = DeviceChange(
        device="sensor", state="open", t_monotonic_ns=0, t_utc_ns=EPOCH_NS, info_json=json.dumps(info)
    )
    run = Run(drawn().config)
    told = [result.reason for result in run.feed(opened) if isinstance(result, StatusChange)]
    run.close()
    assert told[0] == f"what the driver of sensor states of its filters is not used: {said}"
    assert told[1] == "sensor opened"


def test_a_kept_state_holds_what_drivers_stated_of_devices_that_are_not_open_yet() -> None:
    (channel,) = drawn().config.channels
    before, now = DriverFilters(channel), DriverFilters(channel)
    before.take({"sensor": ("flat",), "reference": ("lowpass corner_hz=30",)})
    now.hear("sensor", {"filters": ["flat"]})
    kept = keep(before, "", Estimation(before.channel, 1.0), None, 1.0, 0.0, 0)
    assert take_up(kept, now, 1.0).reason == "restored from the previous run"
    assert now.by_device == before.by_device
    assert now.channel.known_filters == before.channel.known_filters
    assert pack(now.snapshot()) == pack(before.snapshot())
