"""The numbers behind a report's figures: results read, residuals, spectrum, shares of the variance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.report import diagrams, tables, timelines
from agent.report.frequencies import over_frequency, response
from agent.report.material import window_verdict
from agent.report.result import CalibrationResult, ResultError, from_update, parse
from agent.report.timelines import SOURCES, variance_shares
from agent.report.trace import PHASE_BINS, Trace, by_phase, residuals, spans, spectrum
from agent.report.units import in_words, output_unit, sensitivity_unit
from calib.geometry import along, clamp
from calib.model import PARAMETERS
from calib.rounding import plus_minus
from tests.unit.results import calibration, window

S = np.array([[10.0, -0.1, 0.05], [0.2, 9.9, 0.1], [-0.1, 0.15, 10.2]])
Q = np.array([0.3, -0.5, 0.1])


def fields(**changes: Any) -> dict[str, Any]:
    """What `fieldcal calibrate --json -` prints of S and Q."""
    flags = {"sensitivity": [[True] * 3] * 3, "offset": [True] * 3}
    u = {"sensitivity": [[0.01] * 3] * 3, "offset": [0.02] * 3}
    expanded = {"sensitivity": [[0.02] * 3] * 3, "offset": [0.04] * 3, "coverage_factor": 2.0}
    return {
        "sensitivity": S.tolist(), "offset": Q.tolist(), "standard_uncertainty": u, "expanded_uncertainty": expanded,
        "covariance": np.diag([1e-4] * 9 + [4e-4] * 3).tolist(), "determined": flags, "nuisances": {}, "lag_s": None,
        "rate_hz": 1000.0, "status": "valid", "reasons": [], "windows": [], "statistics": {}, "version": "0.1.0",
    } | changes  # fmt: skip


def result(**changes: Any) -> CalibrationResult:
    return parse(fields(**changes), "name")


def test_each_result_stands_once_in_the_legend() -> None:
    drawn = diagrams.transverse_sensitivities([result(method="1"), result(method="3")])
    assert drawn is not None
    (legend,) = drawn.legends
    assert [text.get_text() for text in legend.get_texts()] == ["Method 1", "Method 3"]


def test_a_result_is_read_in_the_order_of_the_parameters() -> None:
    found = result(method="1", budget={"type A": {p: float(k) for k, p in enumerate(PARAMETERS)}, "lag": [2.0] * 12})
    np.testing.assert_array_equal(found.values, [*S.ravel(), *Q])
    np.testing.assert_array_equal(found.expanded_uncertainty, [0.02] * 9 + [0.04] * 3)
    np.testing.assert_array_equal(found.budget["type A"], range(12))
    np.testing.assert_array_equal(found.budget["lag"], [2.0] * 12)
    assert found.label == "Method 1"
    assert found.determined.all()
    assert not found.refused
    assert result().label == "name"


def test_the_response_is_told_in_per_cent_of_s_and_as_numbers() -> None:
    re, im = 1.1 * S, np.zeros((3, 3))
    im[0, 0], re[1, 1] = 0.2 * S[0, 0], 0.9 * S[1, 1]
    known = {"low_hz": 2.0, "high_hz": 8.0, "sensitivity_re": re.tolist(), "sensitivity_im": im.tolist()}
    silent = {"low_hz": 8.0, "high_hz": 9.0, "sensitivity_re": None, "sensitivity_im": None}
    bands = [known | {"standard_uncertainty": [[0.01] * 3] * 3}, silent | {"standard_uncertainty": None}]
    found = result(response=bands, reference_frequency_hz=4.0, valid_band_hz=[3.0, 5.0])
    middle_hz, relative, U = over_frequency(found)
    np.testing.assert_allclose(middle_hz, [4.0], rtol=1e-12)
    np.testing.assert_allclose(relative, [[np.hypot(1.1, 0.2) - 1.0, -0.1, 0.1]], rtol=1e-12)
    np.testing.assert_allclose(U, [0.02 / np.abs(np.diag(S))], rtol=1e-12)
    assert f"<td>2 to 8</td><td>{plus_minus(np.hypot(1.1, 0.2) * S[0, 0], 0.02)}</td>" in tables.over_frequency(found)
    assert response(found) is not None
    assert response(result(response=bands[1:])) is None


def test_a_held_window_is_neither_used_nor_refused() -> None:
    numbers = {"innovation_chi2": 90.0, "innovation_chi2_threshold": 30.0}
    told = [
        {"start_s": 0.0, "used": True, "numbers": numbers},
        {"start_s": 5.0, "used": False, "reason": "held until further windows confirm a jump", "numbers": numbers},
        {"start_s": 9.0, "used": False, "reason": "the reference is calm here", "numbers": {}},
        {"start_s": 12.0, "used": False, "reason": "the sensor does not follow", "numbers": {}},
    ]
    reports = [msgspec.structs.replace(window(1), **fields) for fields in told]
    verdicts = [window_verdict(report) for report in reports]
    assert [verdict.verdict for verdict in verdicts] == ["used", "held", "calm", "refused"]
    drawn = timelines.windows(verdicts)
    assert drawn is not None
    assert [text.get_text() for text in drawn.legends[0].get_texts()] == ["used", "held", "refused", "calm"]
    bars = [bar.get_facecolor() for bar in drawn.axes[0].patches]
    assert len(set(bars)) == 4
    patches = {
        text.get_text(): patch.get_facecolor()
        for patch, text in zip(drawn.legends[0].get_patches(), drawn.legends[0].get_texts(), strict=True)
    }
    assert [patches[verdict.verdict] for verdict in verdicts] == bars
    words = tables.windows(replace(result(), windows=tuple(verdicts)))
    assert [words.count(f"<td>{word}</td>") for word in ("yes", "held", "no")] == [1, 1, 2]


def test_the_degrees_of_freedom_are_those_on_which_k_rests() -> None:
    """Of files, a number alone is that of the type A part (calib.Calibration), and not that of the combined u."""
    parts = {"sensitivity": [[30.0, None, 2e9]] + [[40.0] * 3] * 2, "offset": [50.0] * 3}
    told = result(uncertainty_kind="combined", degrees_of_freedom=92.0, effective_degrees_of_freedom=parts)
    np.testing.assert_array_equal(told.degrees_of_freedom, [30.0, np.nan, np.inf, *[40.0] * 6, *[50.0] * 3])
    assert np.isnan(result(uncertainty_kind="combined", degrees_of_freedom=92.0).degrees_of_freedom).all()
    assert (result(uncertainty_kind="type A", degrees_of_freedom=92.0).degrees_of_freedom == 92.0).all()
    assert (result(degrees_of_freedom=[7.0] * 12).degrees_of_freedom == 7.0).all()


def test_null_is_not_determined() -> None:
    found = result(
        sensitivity=[[10.0, None, None]] + [[None] * 3] * 2, offset=None, covariance=None,
        determined={"sensitivity": [[True, False, False]] + [[False] * 3] * 2, "offset": None},
    )  # fmt: skip
    assert found.determined.tolist() == [True] + [False] * 11
    assert found.values[0] == 10.0
    assert np.isnan(found.values[1:]).all()
    assert np.isnan(found.covariance).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensitivity": [[1.0, 2.0], [3.0, 4.0]]}, r"field sensitivity: must be 3 x 3 numbers.*\[\[1.0, 2.0\]"),
        ({"offset": ["a", 1, 2]}, "field offset: must be 3 numbers"),
        ({"covariance": [[1.0] * 12] * 11}, "field covariance: must be 12 x 12"),
        (
            {"standard_uncertainty": {"offset": 7}, "expanded_uncertainty": None, "covariance": None},
            None,
        ),  # for all three
        ({"windows": [{"start_s": 1.0}]}, "field windows: .*stop_s"),
        ({"windows": 3}, "field windows"),
        ({"files": [{"path": 3}]}, "field files"),
        ({"budget": {"lag": [1.0]}}, "field budget.lag: must be 12 numbers"),
    ],
)
def test_a_field_that_is_wrong_is_named(changes: dict[str, Any], words: str | None) -> None:
    if words is None:
        assert result(**changes).standard_uncertainty[9:].tolist() == [7.0] * 3
        return
    with pytest.raises(ResultError, match=words):
        result(**changes)


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(ResultError, match="not a calibration result"):
        parse({"a": 1}, "name")


def test_a_recorded_calibration_blanks_what_it_does_not_determine() -> None:
    found = parse(from_update(calibration(3, qz_known=False), (), {}), "name")
    assert found.determined.tolist() == [True] * 11 + [False]
    assert np.isnan(found.offset[2])
    assert np.isnan(found.covariance[11]).all()
    assert found.expanded_uncertainty[0] == 12.0
    assert found.unit == "count"


def moving(lag_s: float) -> Trace:
    """6 s of 3 Hz at 5 m/s2 on the clamp; the sensor lags."""
    pose = clamp(np.deg2rad(35), np.deg2rad(30), position="30 deg")
    t, omega = np.arange(6000) / 1000.0, 2 * np.pi * 3
    u, du = 5 * np.sin(omega * t)[:, None], 5 * omega * np.cos(omega * t)[:, None]
    felt = 5 * np.sin(omega * (t - lag_s))[:, None]
    return Trace(t, (felt @ pose.direction.T + pose.gravity_mps2) @ S.T + Q, u, du, pose)


def test_what_follows_the_model_leaves_nothing_and_a_lag_shows_a_quarter_cycle_off() -> None:
    assert residuals(moving(0.0), result()).rms.max() < 1e-12
    lagging = residuals(moving(0.002), result())
    # To first order the residual is S d a' lag: rms 5 omega lag / sqrt 2 of the direction's part in each output.
    expected = np.abs(S @ moving(0.0).pose.direction[:, 0]) * 5 * 2 * np.pi * 3 * 0.002 / np.sqrt(2)
    np.testing.assert_allclose(lagging.rms, expected, rtol=2e-3)  # second order: (omega lag)^2 = 1.4e-3
    assert lagging.frequency_hz == pytest.approx(3.0, rel=1e-3)
    assert lagging.phase_rad is not None
    middle, mean, _ = by_phase(lagging.phase_rad, lagging.residual)
    quarter = mean[:, 0] @ np.sin(middle), mean[:, 0] @ np.cos(middle)
    assert abs(quarter[1]) < 0.03 * abs(quarter[0])
    assert quarter[0] * (S @ moving(0.0).pose.direction)[0, 0] > 0  # late: what is left follows the sine
    # With the lag in the result it is gone but for the second order.
    assert np.all(residuals(moving(0.002), result(lag_s=0.002)).rms < 0.03 * expected)


def test_unknown_gravity_or_offset_leaves_the_motion_only() -> None:
    trace = moving(0.0)
    ac = replace(trace, pose=along(trace.pose.direction[:, 0]))
    for seen in (residuals(ac, result()), residuals(trace, result(offset=None))):
        assert seen.centred
        np.testing.assert_allclose(seen.indications.mean(axis=0), 0, atol=1e-12)
        assert seen.rms.max() < 1e-12


def test_a_column_that_is_not_known_matters_only_where_it_moves() -> None:
    column = [[row[0], None, None] for row in S.tolist()]
    u = np.sin(np.arange(500) / 20)[:, None]
    for axis, known in (((1, 0, 0), True), ((0, 1, 0), False)):
        pose = along(axis)
        trace = Trace(np.arange(500) / 100.0, u @ pose.direction.T @ S.T, u, np.cos(np.arange(500) / 20)[:, None], pose)
        rms = residuals(trace, result(sensitivity=column, offset=None)).rms
        assert rms.max() < 1e-12 if known else np.isnan(rms).all()


def test_at_rest_there_is_no_phase() -> None:
    trace = moving(0.0)
    rest = replace(trace, reference=np.empty((6000, 0)), reference_rate=np.empty((6000, 0)),
                   pose=replace(trace.pose, direction=np.zeros((3, 0))))  # fmt: skip
    seen = residuals(rest, result())
    assert seen.frequency_hz is None
    assert seen.phase_rad is None


def test_the_spectrum_holds_the_variance() -> None:
    noise = np.random.default_rng(5).normal(0, [1.0, 2.0, 0.5], (100_000, 3))
    frequency, density = spectrum(noise, 1000.0)
    total = (density**2).sum(axis=0) * (frequency[1] - frequency[0])
    # 96 half-overlapped segments: the variance of a variance is below 1 %; three of them.
    np.testing.assert_allclose(total, [1.0, 4.0, 0.25], rtol=0.03)
    assert frequency[-1] == 500.0
    tone = np.sin(2 * np.pi * 20 * np.arange(8192) / 1000)[:, None]
    frequency, density = spectrum(tone, 1000.0)
    assert frequency[np.argmax(density)] == pytest.approx(20, abs=0.5)


def test_bins_of_phase() -> None:
    phase = np.random.default_rng(6).uniform(0, 2 * np.pi, 50_000)
    middle, mean, error = by_phase(phase, np.stack([np.sin(phase), np.full_like(phase, 2.0), phase * 0], axis=1))
    assert len(middle) == PHASE_BINS
    np.testing.assert_allclose(mean[:, 0], np.sin(middle), atol=0.01)  # a bin's curvature and 2000 points in it
    np.testing.assert_allclose(mean[:, 1], 2.0)
    np.testing.assert_allclose(error[:, 1:], 0, atol=1e-9)


def test_stretches_keep_every_extreme() -> None:
    values = np.random.default_rng(7).normal(size=(1003, 3))
    middle, low, high = spans(np.arange(1003.0), values, 100)
    assert len(middle) == 100
    np.testing.assert_array_equal(low.min(axis=0), values.min(axis=0))
    np.testing.assert_array_equal(high.max(axis=0), values.max(axis=0))
    assert (np.diff(middle) > 0).all()


def test_shares_of_the_variance_are_whole_and_the_largest_are_named() -> None:
    sources = {f"source {k}": [float(k)] * 12 for k in range(SOURCES + 3)}
    names, shares = variance_shares(result(budget=sources))
    assert names == [f"source {k}" for k in range(SOURCES + 2, 2, -1)] + ["all others"]
    np.testing.assert_allclose(shares.sum(axis=0), 100.0)
    squares = np.arange(SOURCES + 3.0) ** 2
    np.testing.assert_allclose(shares[0], 100 * squares[-1] / squares.sum())
    np.testing.assert_allclose(shares[-1], 100 * squares[:3].sum() / squares.sum())
    assert variance_shares(result())[0] == []


def test_units_in_both_languages() -> None:
    assert (output_unit("m/s2"), sensitivity_unit("m/s2")) == ("m/s²", "1")
    assert (output_unit("mV"), sensitivity_unit("mV")) == ("mV", "mV/(m/s²)")
    assert in_words("rate_hz") == "rate in Hz"
    assert in_words("OFFSET_X_H") == "OFFSET_X_H"
