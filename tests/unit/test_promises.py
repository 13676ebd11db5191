"""What the check of a driver's blocks lets pass: what real drivers, clocks and machines do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.promises import BadDriverError, BlockCheck
from hw.sensor import boot_id

INFO = DeviceInfo("lab", "lab", "7", "count", 3, 100.0)
S = 1_000_000_000  # ns
OPENED = (1000 * S, 1_790_000_000 * S)
YEAR = 365 * 86_400 * S


def block(second: float, first_index: int, utc_step_ns: int = 0, **changes: Any) -> SampleBlock:
    """Ten samples that arrive in two bursts, so many seconds after the opening."""
    arrival_ns = OPENED[0] + round(second * S)
    told = SampleBlock(
        "imu", boot_id(), OPENED[1] + round(second * S) + utc_step_ns, first_index, 100.0,
        np.array([arrival_ns - S // 20, arrival_ns], np.int64), np.array([4, 10], np.int32),
        np.arange(30, dtype=np.int32).reshape(10, 3),
    )  # fmt: skip
    return replace(told, **changes)


class Machine:
    """The clocks of a machine, which a test sets."""

    def __init__(self) -> None:
        self.after_s, self.utc_step_ns = 0.0, 0

    def __call__(self) -> tuple[int, int]:
        after_ns = round(self.after_s * S)
        return OPENED[0] + after_ns, OPENED[1] + after_ns + self.utc_step_ns


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def check(machine: Machine) -> BlockCheck:
    return BlockCheck("imu", INFO, OPENED, machine)


def test_the_first_block_carries_restart_and_the_others_what_they_say(machine: Machine, check: BlockCheck) -> None:
    machine.after_s = 2.0
    assert check.taken(block(1.0, 0)).flags == BlockFlags.RESTART
    assert check.taken(block(1.5, 10)).flags == BlockFlags.NONE
    assert check.taken(block(2.0, 20, flags=BlockFlags.GAP)).flags == BlockFlags.GAP


def test_numbers_of_numpy_become_numbers_of_python(machine: Machine, check: BlockCheck) -> None:
    machine.after_s = 1.0
    plain = block(1.0, 5)
    numpys: dict[str, Any] = {
        "t_utc_ns": np.int64(plain.t_utc_ns), "first_index": np.int64(5), "nominal_rate_hz": np.float32(100.0),
        "temperature_raw": np.uint16(7), "temperature_degc": np.float32(21.5),
    }  # fmt: skip
    taken = check.taken(replace(plain, **numpys))
    values = (taken.t_utc_ns, taken.first_index, taken.nominal_rate_hz, taken.temperature_raw, taken.temperature_degc)
    assert values == (plain.t_utc_ns, 5, 100.0, 7, 21.5)
    assert [type(value) for value in values] == [int, int, float, int, float]


def test_the_block_shares_no_memory_with_the_driver(machine: Machine, check: BlockCheck) -> None:
    machine.after_s = 1.0
    given = block(1.0, 0, indications=np.zeros((20, 6), np.int32)[::2, ::2])
    taken = check.taken(given)
    assert taken.indications.flags.c_contiguous
    for name in ("indications", "burst_t_monotonic_ns", "burst_count"):
        assert not np.shares_memory(getattr(given, name), getattr(taken, name))


@pytest.mark.parametrize("step_ns", [30 * YEAR, -30 * YEAR, 3600 * S, -1])
@pytest.mark.parametrize("read_before", [True, False], ids=["read before the step", "read after it"])
def test_utc_may_be_set_while_a_block_is_read(
    machine: Machine, check: BlockCheck, step_ns: int, read_before: bool
) -> None:
    # A Raspberry Pi has no clock with a battery: at a start without network it takes the time of its last stop.
    machine.after_s = 1.0
    check.taken(block(1.0, 0))
    machine.after_s, machine.utc_step_ns = 1.5, step_ns
    check.taken(block(1.5, 10, 0 if read_before else step_ns))
    machine.after_s = 2.0
    check.taken(block(2.0, 20, step_ns))
    machine.after_s = 2.5
    with pytest.raises(BadDriverError, match="t_utc_ns is"):
        check.taken(block(2.5, 30, step_ns + 2 * 86_400 * S))


def test_a_burst_may_bring_the_last_samples_of_a_block_and_the_first_of_the_next(
    machine: Machine, check: BlockCheck
) -> None:
    machine.after_s = 2.0
    check.taken(block(1.0, 0))
    cut = block(2.0, 10)
    check.taken(replace(cut, burst_t_monotonic_ns=np.array([OPENED[0] + S, OPENED[0] + 2 * S], np.int64)))
    with pytest.raises(BadDriverError, match=r"0.5 s before"):
        check.taken(block(1.55, 20))


def test_samples_may_be_missing_and_may_wait_from_before_the_opening(machine: Machine, check: BlockCheck) -> None:
    check.taken(block(-59.0, 0))
    check.taken(block(-30.0, 10**9))
    with pytest.raises(BadDriverError, match="or the opening, allows"):
        BlockCheck("imu", INFO, OPENED, machine).taken(block(-60.0, 0))


def test_a_clock_of_its_own_runs_ahead_of_this_machine(machine: Machine) -> None:
    check = BlockCheck("imu", replace(INFO, own_clock=True), OPENED, machine)
    check.taken(block(1000.0, 0))
    check.taken(block(1001.0, 10, YEAR))
    with pytest.raises(BadDriverError, match="before"):
        check.taken(block(1000.5, 20))
