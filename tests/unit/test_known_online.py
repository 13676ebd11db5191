"""Known filters on-line: stated in the configuration of a channel, divided out window by window."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import Config
from agent.core.events import Acceleration, CalibrationUpdate, Event
from agent.core.pipeline import Pipeline
from benchmarks.online.life import Gateway
from benchmarks.online.node import Node, Stated, Timing, node
from benchmarks.online.runner import Run, visits
from hw.virtual.building import Building
from tests.pair import Filter, lowpass
from tests.unit.test_response_online import BROAD, SEED, newest

WINDOWS = 6
NEAR = lowpass(2, 14.0)  # the motion ends at 12 Hz
NEAR_TEXT = ["lowpass order=2 corner_hz=14 u_corner_pct=2"]


@cache
def told(where: str) -> CalibrationUpdate:
    """The calibration in force after some windows; the filter is in the sensor or in the reference, "" in none."""
    drawn = node(SEED, all_axes=True, stated=Stated(lag_s=0.01), timing=Timing(20.0, 60.0, WINDOWS))
    filters = {"prior": ["flat"], "certificate": ["flat"]}
    if where:
        filters["prior" if where == "sensor" else "certificate"] = NEAR_TEXT
    config = stating(drawn.config, **filters)
    building = filtered(drawn, where, NEAR) if where else filtered(drawn, "sensor", None)
    return newest(replace(drawn, config=config), visits(building, range(WINDOWS)))


def filtered(drawn: Node, where: str, response: Filter | None) -> Building:
    parameters = replace(drawn.building.parameters, band=BROAD)
    return Building(replace(parameters, **{where: replace(getattr(parameters, where), response=response)}), SEED)


def stating(config: Config, **filters: list[str]) -> Config:
    """The configuration of a channel with these filters in its sections."""
    (channel,) = config.channels
    stated = {name: getattr(channel, name).model_copy(update={"filters": tuple(of)}) for name, of in filters.items()}
    return config.model_copy(update={"channels": (channel.model_copy(update=stated),)})


@pytest.mark.one_case
@pytest.mark.parametrize("where", ["sensor", "reference"])
def test_a_near_filter_that_is_stated_changes_neither_s_nor_q(where: str) -> None:
    found, without = told(where), told("")
    assert found.windows == without.windows >= WINDOWS - 1
    gain = abs(NEAR(np.array([found.reference_frequency_hz]))[0]) if where == "sensor" else 1.0
    S, wanted = np.array(found.sensitivity), gain * np.array(without.sensitivity)
    assert np.abs(S - wanted).max() < 5e-4
    assert np.abs(np.array(found.offset) - without.offset).max() < 0.006


@pytest.mark.one_case
@pytest.mark.parametrize("stated", [True, False])
def test_a_filter_that_was_set_otherwise_is_a_changed_response_and_no_drift(*, stated: bool) -> None:
    """The sensor's output rate is doubled between two runs. If nobody states that, its windows are held."""
    drawn = node(SEED, all_axes=True, stated=Stated(lag_s=0.002), timing=Timing(20.0, 60.0, 2 * WINDOWS))
    other = lowpass(2, 28.0)
    before = stating(drawn.config, prior=NEAR_TEXT, certificate=["flat"])
    after = stating(drawn.config, prior=["lowpass order=2 corner_hz=28 u_corner_pct=2"], certificate=["flat"])
    gateway = Gateway(before, np.zeros(12))
    gateway.feed(visits(filtered(drawn, "sensor", NEAR), range(WINDOWS)))
    assert [report.used for report in gateway.reports] == [True] * WINDOWS
    gateway.restart(after if stated else before)
    gateway.feed(visits(filtered(drawn, "sensor", other), range(WINDOWS, 2 * WINDOWS)))
    used = [report.used for report in gateway.reports[WINDOWS:]]
    assert gateway.status == ("VALID" if stated else "HELD")
    assert used == [stated] * WINDOWS


def test_faults_are_told_with_their_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prior = ["[channels.prior]", "sensitivity = 1.0", 'filters = ["lowpass corner=31"]']
    certificate = ["[channels.certificate]", 'filters = ["flat", "sinc points=16"]']
    table = ["[channels.certificate.response]", "frequency_hz = [1.0, 2.0]", "relative_sensitivity = [1.0]"]
    device = ["[[devices]]", 'driver = "serial-csv"']
    devices = [*device, 'name = "s"', 'options = { port = "/dev/s", rate_hz = 50 }']
    devices += [*device, 'name = "r"', 'options = { port = "/dev/r", rate_hz = 50 }']
    channel = ["[[channels]]", 'sensor = "s"', 'reference = "r"', "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]"]
    lines = [*devices, *channel, *prior, *certificate, *table]
    path = tmp_path / "site.toml"
    path.write_text("\n".join(lines) + "\n")
    assert run_cli(["check", str(path)]) == 2
    said = capsys.readouterr()
    told = said.err + said.out
    for text, line in (
        ("'corner=31': lowpass takes corner_hz=..., order=..., u_corner_pct=...", prior[-1]),
        ("sinc needs rate_hz=...", certificate[-1]),
        ("relative_sensitivity: 1 values, but frequency_hz has 2; give one for each", table[2]),
    ):
        (row,) = [row for row in told.splitlines() if text in row]
        assert f"line {lines.index(line) + 1}:" in row


@pytest.mark.slow
def test_a_restored_state_goes_on_bit_for_bit() -> None:
    drawn = node(SEED, all_axes=True, stated=Stated(lag_s=0.01), timing=Timing(20.0, 60.0, 4))
    config = stating(drawn.config, prior=NEAR_TEXT, certificate=["flat"])
    events = list(visits(filtered(drawn, "sensor", NEAR), range(4)))
    assert_goes_on(config, events, len(events) // 2)


def assert_goes_on(config: Config, events: list[Event], cut: int) -> None:
    """Check that a pipeline restored after `cut` events gives the same results as one that was never stopped."""
    whole, first = Run(config), Run(config)
    expected = [result for event in events for result in whole.feed(event)]
    found = [result for event in events[:cut] for result in first.feed(event)]
    again = Pipeline.restore(config.model_dump_json(), first.pipeline.snapshot())
    found += [r for event in events[cut:] for r in again.step(event) if not isinstance(r, Acceleration)]
    assert found == expected
    for run in (whole, first):
        run.close()
