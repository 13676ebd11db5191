"""Samples that nobody can compute with cost their window; a fault of the program is told as one. The agent goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.core import channel, streams
from agent.core.estimation import Estimation
from agent.core.events import DeviceChange, StatusChange, WindowReport
from agent.core.fault import description
from agent.core.pipeline import Pipeline
from agent.recording.messages import decode, encode
from agent.supervision.notify import SystemdNotifier
from agent.supervision.supervisor import Supervisor
from tests.unit.mounted_site import Site, begun, said, site_config, updates, windows

ROOT = Path(__file__).parents[2]


@pytest.mark.one_case
@pytest.mark.parametrize("device", ["s", "r"])
@pytest.mark.parametrize("factor", [1e200, np.inf, 1e13])
@pytest.mark.filterwarnings("ignore:invalid value encountered in multiply")  # 0 times inf, in the test
def test_samples_beyond_all_reckoning_cost_their_window_alone(device: str, factor: float) -> None:
    """A driver from elsewhere may hand on 1e200."""
    site = begun(site_config())
    before = updates(site.play(3))[-1]
    site.spoiled = {device: factor}
    found = site.play(2)
    site.spoiled = {}
    closed = windows([*found, *site.play(5)])
    refused = [w for w in closed if not w.used]
    assert 2 <= len(refused) <= 4  # two, and their neighbours: a window needs a second of samples beyond its ends
    for window in refused:
        assert window.reason.startswith(f"{device}: an indication is ")
        assert window.reason.endswith(", too large to compute with (1e+12 at most)")
        assert window.fault == ""
    assert [w.used for w in closed][-2:] == [True, True]
    assert {status for status, _ in said(site.results)} == {"UNCALIBRATED", "VALID"}
    np.testing.assert_allclose(updates(site.results)[-1].sensitivity, before.sensitivity, atol=5e-3)


def broken(*_: Any, **__: Any) -> Any:
    raise ValueError("operands <array at 0x7f12ab> could not be\nbroadcast together")


def break_the_windows(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(streams, "windows_in", broken)
    return "agent/core/streams.py"


def break_the_judge(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(Estimation, "_tried_of", broken)
    return "agent/core/estimation.py"


def break_the_results(patch: pytest.MonkeyPatch) -> str:
    patch.setattr(channel, "calibration_update", broken)
    return "agent/core/channel.py"


@pytest.mark.one_case
@pytest.mark.parametrize("breaking", [break_the_windows, break_the_judge, break_the_results])
def test_a_fault_of_the_program_is_told_with_its_place_and_the_agent_goes_on(
    breaking: Callable[[pytest.MonkeyPatch], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    site = begun(site_config())
    site.play(3)
    with monkeypatch.context() as patch:
        file = breaking(patch)
        found = site.play(2)
    faults = [w for w in windows(found) if w.fault]
    assert len(faults) == 2
    for window in faults:
        _, at, place = window.fault.partition(": ")[0].partition(" at ")
        name, _, line = place.partition(":")
        assert (at, name) == (" at ", file)
        assert 0 < int(line) <= len((ROOT / name).read_text().splitlines())
        assert window.fault == f"ValueError at {place}: operands <array> could not be broadcast together"
        assert window.reason == f"a fault of the program, not of the data; please report it: {window.fault}"
        assert ("VALID", f"S and Q are not updated: {window.reason}") in said(found)
        assert decode("fieldcal.v1.Window", encode(7, window)) == (7, window)
    assert [w.used for w in windows(site.play(3))][-2:] == [True, True]


def test_a_run_with_a_fault_replays_to_the_same_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "windows_in", broken)
    first, second = (begun(site_config()) for _ in range(2))
    first.play(3)
    second.play(2)
    second.pipeline = Pipeline.restore(site_config().model_dump_json(), second.pipeline.snapshot())
    second.play(1)
    assert second.results == first.results
    assert sum(bool(w.fault) for w in windows(first.results)) == 2


def test_an_exception_that_no_line_of_the_program_raised_has_no_place() -> None:
    with pytest.raises(np.linalg.LinAlgError) as caught:
        np.linalg.inv(np.zeros((2, 2)))
    assert description(caught.value) == "LinAlgError at an unknown place: Singular matrix"  # tests are not the program


def test_the_supervision_logs_a_fault_as_an_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(streams, "windows_in", broken)
    site: Site = begun(site_config())
    results = [r for r in site.play(3) if isinstance(r, WindowReport | StatusChange)]
    supervisor = Supervisor(site_config(), "r", 0, None, SystemdNotifier({}))  # type: ignore[arg-type]  # looked at by ticks
    lost = DeviceChange(device="s", state="lost", t_monotonic_ns=0, t_utc_ns=0)
    supervisor.on_event(lost, results)
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    [fault] = {w.fault for w in windows(site.results) if w.fault}
    assert errors == [f"a fault of the program cost s a window, please report it: {fault}"] * 2
