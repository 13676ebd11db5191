"""kill -9, a few times; `make faults` does it 200 times, at every write, and 20 times with a key."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import kill, states
from tests.faults.invariants import read_store
from tests.faults.needs import require
from tests.faults.rig import rig, stop

pytestmark = pytest.mark.faults


def test_at_random_moments(tmp_path: Path) -> None:
    outcome = kill.at_random_moments(tmp_path, 8)
    assert outcome.good, outcome
    assert outcome.findings.restored >= 4, outcome


def test_at_every_fortieth_write(tmp_path: Path) -> None:
    require("strace")
    outcome = kill.at_every_write(tmp_path, 40)
    assert outcome.good, outcome
    assert outcome.findings.calibrations > 8, outcome


def test_a_calibration_of_another_device_is_not_taken(tmp_path: Path) -> None:
    with rig(tmp_path, kill.SEED) as r:
        with r.agent() as agent:
            r.run(agent, until=lambda: "calibration from" in r.output)
            assert stop(agent) == 0, r.output
        before = read_store(r.data_dir)
        r.config.write_text(r.config.read_text().replace('"R1"', '"R2"'))
        with r.agent() as agent:
            r.run(agent, until=lambda: len(read_store(r.data_dir)) > len(before))
            assert stop(agent) == 0, r.output
        of_the_other = read_store(r.data_dir)[len(before) :]
    assert of_the_other[0].what == "status"
    assert of_the_other[0].fields["status"] == "UNCALIBRATED"


def test_states_go_on_bit_for_bit_and_forged_ones_are_refused(tmp_path: Path) -> None:
    outcome = states.killed(tmp_path, 2)
    assert outcome.good, outcome
