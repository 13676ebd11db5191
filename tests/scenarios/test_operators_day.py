"""A day of an operator's life, in real time: upgrade, a clock that shifts, a power cut, references swapped, an accept.

The gateway begins with the state file that version 0.1.0 left (tests/replay/golden/format-2).
"""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.recording.reading import RecordingReader
from tests import golden_site
from tests.faults.clock import clock_shim
from tests.faults.needs import require
from tests.golden_site import SENSOR, U_REFERENCE_PCT
from tests.replay.golden_files import GOLDEN, STATE
from tests.scenarios.operators_day import WINDOW_S, Site
from tests.scenarios.processes import fieldcal, interrupt, recordings, results

HOUR_S = 3600
pytestmark = pytest.mark.nightly
U_PRIOR_PCT = 2.0
MAIN, TRANSVERSE = [0, 4, 8], [1, 2, 3, 5, 6, 7]


@dataclass(frozen=True)
class Day:
    """What the day left: all results of the store, and what commands printed."""

    golden: dict[str, Any]  # the calibration in force in the golden state file
    calibrations: list[dict[str, Any]]  # since the upgrade
    proposed: dict[str, Any]  # the calibration in the estimate that the operator accepted
    accepted: str  # the answer to the command
    shown: dict[str, Any]
    audited: tuple[int, str]
    killed: Path
    data_dir: Path
    output: str

    def of_run(self, number: int) -> list[dict[str, Any]]:
        """The calibrations of one run of the program, counted from 0."""
        runs = list(dict.fromkeys(c["run_id"] for c in self.calibrations))
        return [c for c in self.calibrations if c["run_id"] == runs[number]]


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Day]:
    require("gcc")
    directory = tmp_path_factory.mktemp("operator")
    step = directory / "step"
    with pytest.MonkeyPatch.context() as patch:
        for name, value in clock_shim(directory, step).items():
            patch.setenv(name, value)  # for the processes that are started from here on
        site = Site(directory, step)
        try:
            yield _lived(site)
        finally:
            site.close()


def _lived(site: Site) -> Day:
    shutil.copy(GOLDEN / "format-2" / STATE, site.data_dir / STATE)
    before = results(site.data_dir, "calibration")
    with site.running() as gateway:
        site.wait_for("calibration")
        site.shift_clock(HOUR_S, by_s=HOUR_S)
        site.shift_clock(0, by_s=-HOUR_S)
        gateway.send_signal(signal.SIGKILL)
        gateway.wait()
        killed = recordings(site.data_dir)[-1]
    with site.running() as gateway:
        site.wait_for("calibration")
        interrupt(gateway)
    site.fitted = "B"
    with site.running(gate={"policy": "propose"}) as gateway:
        site.wait_for("estimate", 2)
        proposed = results(site.data_dir, "estimate")[-1]
        accepted = fieldcal(
            "command", "accept", "--sequence", str(proposed["sequence"]), "--sensor", SENSOR, "--key", site.key,
            "--data-dir", site.data_dir,
        )  # fmt: skip
        interrupt(gateway)
    site.fitted = "A"
    with site.running(uncertainty={"rotation_deg": 0.22}) as gateway:
        site.wait_for("calibration", 2)
        site.wait(lambda: site.status == "VALID", WINDOW_S, "the status VALID")
        interrupt(gateway)
    shown = fieldcal("show", "--data-dir", site.data_dir, "--json", "-")
    audited = fieldcal("audit", site.data_dir)
    return Day(
        golden=before[-1], calibrations=results(site.data_dir, "calibration")[len(before) :],
        proposed=proposed["calibration"], accepted=accepted.stdout + accepted.stderr,
        shown=json.loads(shown.stdout), audited=(audited.returncode, audited.stdout + audited.stderr), killed=killed,
        data_dir=site.data_dir, output=site.output.read_text(),
    )  # fmt: skip


def u_main_pct(calibration: dict[str, Any]) -> np.ndarray:
    """Relative standard uncertainties (3,) of the main sensitivities."""
    u = np.array(calibration["standard_uncertainty"])[MAIN]
    return np.asarray(100.0 * u / np.abs(np.diag(calibration["sensitivity"])))


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two results put the same S and Q with the same covariance in force."""
    return all(one[name] == other[name] for name in ("sensitivity", "offset", "covariance", "determined"))


@pytest.mark.slow
def test_after_the_upgrade_the_calibration_of_the_older_version_is_in_force(day: Day) -> None:
    first = day.of_run(0)[0]
    assert same(first, day.golden)
    assert (first["made_run_id"], first["made_sequence"]) == (day.golden["run_id"], day.golden["sequence"])
    assert len(day.of_run(0)) >= 4  # and those of a window before and after each step of the clock


def test_every_start_puts_the_calibration_in_force_that_the_run_before_left(day: Day) -> None:
    for number in (1, 2):
        first, before = day.of_run(number)[0], day.of_run(number - 1)[-1]
        assert same(first, before), f"run {number}"
        assert first["made_sequence"] in (before["made_sequence"], before["sequence"])


def test_a_larger_uncertainty_in_the_configuration_is_in_u_before_the_next_window(day: Day) -> None:
    """The prior of the rotation is exchanged when the reference is open, in an update of its own."""
    *_, first = [c for c in day.of_run(3) if c["windows"] == day.of_run(3)[0]["windows"]]
    before = day.of_run(2)[-1]
    u_first, u_before = (np.array(c["standard_uncertainty"])[TRANSVERSE] for c in (first, before))
    assert np.all(u_first > 1.003 * u_before), u_first / u_before
    moved = np.subtract(first["sensitivity"], before["sensitivity"]).ravel()
    assert np.abs(moved / before["standard_uncertainty"][:9]).max() < 0.5


def test_calibrations_go_on_when_the_clock_shifts_by_an_hour(day: Day) -> None:
    apart_s = [(b["t_utc_ns"] - a["t_utc_ns"]) * 1e-9 for a, b in pairwise(day.of_run(0)[1:])]
    assert max(apart_s) > HOUR_S
    assert min(apart_s) < -HOUR_S / 2
    # The first one is what the older version left. The noise of all windows, pooled, changes u by 0.13 % either way.
    for before, after in pairwise(day.of_run(0)[1:]):
        assert np.all(u_main_pct(after) < 1.005 * u_main_pct(before)), "an hour is no reason to trust S less"


def test_the_operator_puts_in_force_what_the_estimate_said(day: Day) -> None:
    assert day.accepted == f"taken: accept of {SENSOR}\n"
    before, accepted = day.of_run(2)
    assert same(accepted, day.proposed)
    assert not same(accepted, before)


def test_no_touch_makes_u_smaller(day: Day) -> None:
    """One window more than before, as in the last run, makes u smaller by less than 1 %."""
    for number, least in ((1, 1.0), (2, 1.0), (3, 0.99)):
        first, before = day.of_run(number)[0], day.of_run(number - 1)[-1]
        assert np.all(u_main_pct(first) >= least * u_main_pct(before)), f"run {number}"


def test_u_is_never_below_what_the_references_can_tell(day: Day) -> None:
    """One reference in the first two runs, two from the third on; an exact batch knows each error once."""
    for number, references in enumerate((1, 1, 2, 2)):
        least_pct = (U_PRIOR_PCT**-2 + references * U_REFERENCE_PCT**-2) ** -0.5
        for calibration in day.of_run(number):
            assert np.all(u_main_pct(calibration) > 0.99 * least_pct), f"run {number}: {u_main_pct(calibration)}"


def test_at_the_end_a_right_calibration_is_in_force(day: Day) -> None:
    sensor = day.shown["sensors"][SENSOR]
    assert sensor["status"]["status"] == "VALID"
    last = day.calibrations[-1]
    assert sensor["calibration"] == last
    truth = np.append(golden_site.SENSITIVITY.ravel(), golden_site.OFFSET_MPS2)
    error = np.append(np.ravel(last["sensitivity"]), last["offset"]) - truth
    assert np.abs(error / last["standard_uncertainty"]).max() < 3.0


def test_everything_replays_bit_for_bit(day: Day) -> None:
    status, said = day.audited
    assert status == 0, said
    files = recordings(day.data_dir)
    assert len(files) == 4
    assert said.count("equal bit for bit") == len(files)
    assert day.killed.suffix == ".active"
    assert not day.killed.exists(), "the start after the power cut closes the recording"
    told = sum(len(step.results) for path in files for step in RecordingReader(path).steps())
    assert told > len(day.calibrations)
    assert "Traceback" not in day.output
