"""The virtual building: its blocks agree with its truth, and each fault (harm) has the effect that its name states."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hw.block import BlockFlags, SampleBlock
from hw.virtual.building import DAY_S, Building, BuildingDevice, BuildingParameters, Weather
from hw.virtual.building_motion import BuildingMotion, BuildingSpectrum
from hw.virtual.harm import (
    Clipped,
    ClockStep,
    DeadChannel,
    FarAway,
    Filtered,
    Harm,
    KnockedOff,
    Lossy,
    Transformed,
    Unplugged,
)
from hw.virtual.harm_kinds import KINDS
from hw.virtual.response import lowpass
from hw.virtual.schedule import rotation
from hw.virtual.timebase import Clock

SENSITIVITY = np.array([[1.01, 0.02, 0.0], [0.0, 0.99, -0.01], [0.03, 0.0, 1.02]])
EXACT = Clock(100.0)


def small(**changes: Any) -> BuildingParameters:
    """One minute of motion every ten minutes, at 100 Hz."""
    parameters = BuildingParameters(
        window_s=60.0, every_s=600.0, sensitivity=SENSITIVITY, offset=np.array([0.1, -0.2, 0.3]),
        sensor=BuildingDevice(0.005, Clock(100.0, 1e-4, 0.0013, 20e-6)),
        reference=BuildingDevice(0.001, Clock(100.0, -6e-5)),
    )  # fmt: skip
    return replace(parameters, **changes)


def of(blocks: list[SampleBlock], device: str) -> list[SampleBlock]:
    return [block for block in blocks if block.device == device]


def values(blocks: list[SampleBlock], device: str) -> np.ndarray:
    return np.concatenate([block.indications for block in of(blocks, device)])


def test_blocks_go_on_in_number_and_time_and_arrive_after_they_were_taken() -> None:
    building = Building(small(), 1)
    for visit in (0, 3):
        blocks = building.visit(visit)
        assert np.all(np.diff([block.t_monotonic_ns for block in blocks]) >= 0)
        for device, instrument in (("sensor", small().sensor), ("reference", small().reference)):
            own, clock = of(blocks, device), instrument.clock
            assert own[0].flags == (BlockFlags.GAP if visit else BlockFlags.NONE)
            start_s, stop_s = building.span(visit)
            assert own[0].first_index == clock.due(start_s) // 32 * 32
            assert own[-1].first_index + own[-1].n == clock.due(stop_s) // 32 * 32
            for before, block in itertools.pairwise(own):
                assert block.first_index == before.first_index + before.n
            for block in own:
                newest_s = clock.times(block.first_index, block.n)[block.burst_count - 1]
                late_s = block.burst_t_monotonic_ns * 1e-9 - newest_s
                assert late_s.min() >= 79e-6
                assert 0.1e-3 < np.median(late_s) < 0.5e-3


def test_any_visit_gives_the_same_bits_whatever_was_asked_before() -> None:
    first, second = Building(small(), 5), Building(small(), 5)
    for visit in range(3):
        second.visit(visit)
    for a, b in zip(first.visit(2), second.visit(2), strict=True):
        assert a.device == b.device
        assert a.indications.tobytes() == b.indications.tobytes()
        assert a.burst_t_monotonic_ns.tobytes() == b.burst_t_monotonic_ns.tobytes()


def test_indications_are_the_truth_of_that_day() -> None:
    """Without noise and with one clock for both devices, V = S (R a_ref + g) + Q holds to rounding."""
    quiet = BuildingDevice(0.0, EXACT)
    turn = rotation(np.array([0.0, 0.6, 0.8]), 0.3)
    step = np.zeros((3, 3))
    step[1, 1] = 0.01
    parameters = small(
        sensor=quiet, reference=quiet, rotation=turn, all_axes=True, steps=((5 * DAY_S, step),),
        every_s=DAY_S, offset_a_day=np.array([0.001, 0.0, -0.002]), offset_per_k=np.array([0.01, 0.0, 0.02]),
        tilt_rad_a_day=np.array([1e-4, -2e-4, 0.0]), weather=Weather(15.0, 10.0, 4.0),
    )  # fmt: skip
    building = Building(parameters, 2)
    for visit in (0, 4, 9):
        blocks = building.visit(visit)
        truth = building.truth(sum(building.span(visit)) / 2)
        V, a = values(blocks, "sensor"), values(blocks, "reference")
        expected = (a @ turn.T + truth.gravity_mps2) @ truth.sensitivity.T + truth.offset
        assert np.abs(V - expected).max() < 1e-12
        assert truth.sensitivity[1, 1] == pytest.approx(0.99 + (0.01 if visit >= 5 else 0.0), abs=1e-15)
    days, day = building.span(9)[0] / DAY_S, 9 + 66 / 2 / DAY_S
    assert truth.gravity_mps2[0] == pytest.approx(-2e-4 * days * 9.80665, rel=1e-4)
    assert np.allclose(truth.offset_at_mean, [0.1 + 0.001 * day, -0.2, 0.3 - 0.002 * day], atol=1e-12)
    warm = truth.temperature_degc - 15.0
    assert np.allclose(truth.offset - truth.offset_at_mean, [0.01 * warm, 0.0, 0.02 * warm], atol=1e-12)


def test_the_sensor_lags_and_moves_with_the_stated_level() -> None:
    parameters = small(lag_s=0.02, sensor=BuildingDevice(0.0, EXACT), reference=BuildingDevice(0.0, EXACT))
    building = Building(replace(parameters, sensitivity=np.eye(3), offset=np.zeros(3)), 3)
    blocks = building.visit(1)
    V, a = values(blocks, "sensor")[:, 1], values(blocks, "reference")[:, 1]
    assert np.abs(V[2:] - a[:-2]).max() < 1e-10  # shifted by two sample periods; times are right to 1e-13 s
    whole = a[100:-100]
    assert whole.std() == pytest.approx(building.level_mps2(1), rel=0.1)
    assert 0.02 <= building.level_mps2(1) <= 0.3
    assert np.abs(values(blocks, "reference")[:, [0, 2]]).max() == 0.0


def test_some_visits_move_elsewhere() -> None:
    building = Building(small(elsewhere=0.3, reference=BuildingDevice(0.0, EXACT)), 4)
    elsewhere = 0
    for visit in range(40):
        spread = values(building.visit(visit), "reference").std(axis=0)
        elsewhere += bool(spread[[0, 2]].max() > 0)
    assert 4 <= elsewhere <= 20  # binomial(40, 0.3) to 3e-3 on either side


def test_motion_between_grid_points_is_the_band_limited_one() -> None:
    """A grid twice as fine gives the same motion: the cubic interpolation differs by 3e-6 of it."""
    band = BuildingSpectrum()
    coarse = BuildingMotion(np.random.default_rng(1), band, (0.0, 20.0), 0.1, np.eye(3)[1:2])
    lines = np.fft.rfft(coarse._value[:, 0])
    fine = np.fft.irfft(lines, 4 * len(coarse._value)) * 4
    time_s = np.arange(len(fine)) / (4 * 32 * band.high_hz)
    inside = (time_s > 1.0) & (time_s < 19.0)
    assert np.abs(coarse.at(time_s[inside])[:, 1] - fine[inside]).max() < 1e-5 * 0.1
    assert np.abs(coarse.at(np.array([0.0, 20.0]))).max() < 1e-15


def visited(harm: Harm, visit: int = 2, **changes: Any) -> tuple[list[SampleBlock], list[SampleBlock]]:
    """The blocks of the visit without and with the fault."""
    parameters = small(**changes)
    return Building(parameters, 6).visit(visit), Building(parameters, 6, harm, 2).visit(visit)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_harm_begins_when_it_says_and_changes_something(kind: str) -> None:
    harm = KINDS[kind](np.random.default_rng(1))
    parameters = small()
    whole, harmed = Building(parameters, 6), Building(parameters, 6, harm, 2)
    assert [b.indications.tobytes() for b in whole.visit(1)] == [b.indications.tobytes() for b in harmed.visit(1)]

    def seen(blocks: list[SampleBlock]) -> list[tuple[Any, ...]]:
        return [
            (b.device, b.first_index, b.t_utc_ns, b.burst_t_monotonic_ns.tobytes(), b.indications.tobytes())
            for b in blocks
        ]

    assert seen(whole.visit(2)) != seen(harmed.visit(2))


def test_samples_lost_and_told_are_missing_by_number() -> None:
    whole, left = visited(Lossy("", "sensor", 0.1, 16, told=True))
    original, first = values(whole, "sensor"), of(whole, "sensor")[0].first_index
    lost = 1 - len(values(left, "sensor")) / len(original)
    assert 0.06 < lost < 0.14  # 413 runs of 16: SD 0.015
    for block in of(left, "sensor"):
        start = block.first_index - first
        assert np.array_equal(block.indications, original[start : start + block.n])
        assert block.flags & BlockFlags.GAP
        assert block.burst_count[-1] == block.n
        assert np.all(np.diff(block.burst_count, prepend=0) > 0)
    assert np.array_equal(values(left, "reference"), values(whole, "reference"))


def test_samples_lost_and_not_told_leave_the_numbers_whole() -> None:
    whole, left = visited(Lossy("", "sensor", 0.1, 1, told=False))
    own = of(left, "sensor")
    for before, block in itertools.pairwise(own):
        assert block.first_index == before.first_index + before.n
    assert all(block.burst_count[-1] == block.n for block in own)
    lost = 1 - len(values(left, "sensor")) / len(values(whole, "sensor"))
    assert 0.085 < lost < 0.115  # 6600 samples: SD 0.0037
    assert own[-1].t_monotonic_ns >= of(whole, "sensor")[-1].t_monotonic_ns - 2e8


def test_a_clock_steps_in_the_middle_of_its_first_visit() -> None:
    whole, stepped = visited(ClockStep("", "reference", "arrival", 0.5))
    late = [
        b.t_monotonic_ns - a.t_monotonic_ns
        for a, b in zip(of(whole, "reference"), of(stepped, "reference"), strict=True)
    ]
    assert set(late) == {0, 500_000_000}
    assert late == sorted(late)
    whole, stepped = visited(ClockStep("", "sensor", "number", 0.5))
    jumped = [b.first_index - a.first_index for a, b in zip(of(whole, "sensor"), of(stepped, "sensor"), strict=True)]
    assert set(jumped) == {0, 50}
    whole, stepped = visited(ClockStep("", "sensor", "utc", -3600.0))
    assert {b.t_utc_ns - a.t_utc_ns for a, b in zip(whole, stepped, strict=True)} == {0, -3600 * 10**9}


def test_what_dies_is_silent_and_what_lives_is_untouched() -> None:
    whole, dead = visited(DeadChannel("", "sensor", 1))
    assert np.ptp(values(dead, "sensor")[:, 1]) == 0.0
    assert np.array_equal(values(dead, "sensor")[:, [0, 2]], values(whole, "sensor")[:, [0, 2]])
    assert not of(visited(Unplugged("", "lost"))[1], "reference")
    assert np.ptp(values(visited(Unplugged("", "constant"))[1], "reference")) == 0.0
    whole, clipped = visited(Clipped("", 0.8))
    level = Building(small(), 6).level_mps2(2)
    assert np.ptp(values(clipped, "sensor")[:, 1]) == pytest.approx(1.6 * level, rel=1e-12)


def test_turned_swapped_and_far_away() -> None:
    quiet: dict[str, Any] = {"sensor": BuildingDevice(0.0, EXACT), "reference": BuildingDevice(0.0, EXACT)}
    order = np.eye(3)[[1, 0, 2]]
    whole, swapped = visited(Transformed("", "sensor", order), **quiet)
    assert np.array_equal(values(swapped, "sensor"), values(whole, "sensor")[:, [1, 0, 2]])
    turn = rotation(np.array([1.0, 0.0, 0.0]), 0.5)
    whole, off = visited(KnockedOff("", turn), **quiet)
    assert np.allclose(values(off, "sensor"), values(whole, "sensor") @ turn.T, atol=1e-12)
    whole, far = visited(FarAway("", 0.6), **quiet)
    a, b = values(whole, "reference")[:, 1], values(far, "reference")[:, 1]
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(0.6, abs=0.3)  # narrow modes: few independent samples


def test_an_imaginary_share_moves_a_quarter_of_a_period_ahead() -> None:
    band = BuildingSpectrum(3.9, 4.1, ((4.0, 0.001),), flat=0.0)
    shape = np.array([[0.01j, 1.0, 0.02]])
    motion = BuildingMotion(np.random.default_rng(1), band, (0.0, 60.0), 0.1, shape)
    time_s = np.arange(5.0, 55.0, 0.01)
    moved, ahead = motion.at(time_s), motion.at(time_s + 1 / 16.0)
    np.testing.assert_allclose(moved[:, 2], 0.02 * moved[:, 1], atol=1e-12)
    assert np.std(moved[:, 0] - 0.01 * ahead[:, 1]) < 0.03 * np.std(moved[:, 0])
    assert 0.009 < np.std(moved[:, 0]) / np.std(moved[:, 1]) < 0.011


def test_filters_of_instruments_multiply_s_at_a_frequency() -> None:
    """A low-pass of first order at 10 Hz shows 0.707 of 10 Hz: in the sensor S is smaller by that, in the reference
    larger; what the building's devices indicate agrees."""
    parameters = small(
        all_axes=True, offset=np.zeros(3), sensor=BuildingDevice(0.0, EXACT), reference=BuildingDevice(0.0, EXACT)
    )
    filtered = replace(parameters, sensor=replace(parameters.sensor, response=lowpass(1, 10.0)))
    undone = replace(parameters, reference=replace(parameters.reference, response=lowpass(1, 10.0)))
    assert Building(parameters, 2).size(10.0) == 1.0
    assert Building(filtered, 2).size(10.0) == pytest.approx(np.sqrt(0.5))
    assert Building(undone, 2).size(10.0) == pytest.approx(np.sqrt(2.0))
    harm = Filtered("low-pass", "sensor", lowpass(1, 10.0))
    assert Building(filtered, 2, harm).size(10.0) == pytest.approx(0.5)
    plain, less = (values(Building(p, 2).visit(1), "sensor")[:, 0] for p in (parameters, filtered))
    spectra = [np.abs(np.fft.rfft((v - v.mean()) * np.hanning(len(v)))) ** 2 for v in (plain, less)]
    hz = np.fft.rfftfreq(len(plain), 0.01)
    near = (hz > 9.5) & (hz < 10.5)
    assert np.sqrt(spectra[1][near].sum() / spectra[0][near].sum()) == pytest.approx(np.sqrt(0.5), rel=0.02)
