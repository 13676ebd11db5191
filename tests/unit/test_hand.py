"""The bench that a person turns while it runs."""

from __future__ import annotations

import numpy as np
import pytest

from agent.cli.run import virtual_bench
from hw.virtual.bench import Bench
from hw.virtual.presets import by_hand
from hw.virtual.schedule import clamp_frame, clamped

RATE_HZ = 250.0


def test_a_turn_changes_what_comes_and_nothing_before():
    bench = Bench(by_hand("clamp", 4), 4)
    before = bench.sensor_values(0, 5000)
    stands_s = bench.parameters.schedule.turn(clamped(55.0, 90.0, np.inf), 8.0)  # type: ignore[attr-defined]
    bench.forget()
    after = bench.sensor_values(0, 5000)
    turned = int(8.0 * RATE_HZ)
    assert stands_s == pytest.approx(9.0)
    np.testing.assert_array_equal(after[:turned], before[:turned])
    held = slice(int(10.0 * RATE_HZ), 5000)
    assert np.abs(after[held].mean(axis=0) - before[held].mean(axis=0)).max() > 1e5  # 4 m/s2
    p = bench.parameters
    felt = p.gravity_mps2 * clamp_frame(*np.deg2rad([55.0, 90.0]))[:, 2]
    expected = p.sensor.sensitivity @ felt + p.sensor.offset
    # 0.2 deg of angles (0.03 m/s2 each), 0.05 m/s2 of the offset, and the motion's mean over ten seconds
    np.testing.assert_allclose(after[held].mean(axis=0), expected, atol=0.3 * p.sensor.nominal_sensitivity)


def test_a_position_taken_again_has_the_same_error_again():
    schedule = by_hand("clamp", 5).schedule
    for at_s, angles in ((5.0, (35.0, 60.0)), (10.0, (55.0, 0.0)), (15.0, (35.0, 60.0))):
        schedule.turn(clamped(*angles, np.inf), at_s)  # type: ignore[attr-defined]
    first, other, again = (schedule.stand(window) for window in (1, 2, 3))
    assert first.alpha_deg == again.alpha_deg != 60.0
    assert first.theta_deg - 35.0 == pytest.approx(other.theta_deg - 55.0)
    assert [schedule.window_at(t_s) for t_s in (4.0, 5.5, 9.0, 14.9, 99.0)] == [0, 1, 1, 2, 3]


def test_the_guided_preset_takes_two_inclinations_of_a_well_known_bench():
    with virtual_bench("guided", 1) as (config, _):
        channel = config.channels[0]
        assert [pose.theta_deg for pose in channel.poses] == [35.0] * 4 + [55.0] * 4
        assert channel.certificate.u_sensitivity_pct == 0.02
        assert channel.uncertainty.angle_deg == 0.2
