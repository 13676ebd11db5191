"""The response over frequency on-line: S of the agent is right for instruments that do not respond alike."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from agent.core.events import Acceleration, CalibrationUpdate, Event
from agent.core.pipeline import Pipeline
from agent.recording.messages import decode, encode, schema_of
from benchmarks.online.config import building_config
from benchmarks.online.node import Node, Stated, Timing, node
from benchmarks.online.runner import Run, visits
from calib.model import Array
from hw.virtual.building import Building
from hw.virtual.building_motion import BuildingSpectrum
from tests.pair import Filter, both, flat, highpass, lowpass, moving_mean, resonance

SEED, WINDOWS = 1, 6
BROAD = BuildingSpectrum(0.5, 12.0)
FILTERS = {
    "flat": flat,
    "low-pass of order 1, 31 Hz": lowpass(1, 31.0),
    "low-pass of order 2, 31 Hz": lowpass(2, 31.0),
    "low-pass of order 4, 40 Hz": lowpass(4, 40.0),
    "moving mean of 16 ms": moving_mean(0.016),
    "resonance at 45 Hz": resonance(45.0, 10.0),
}
SAME_PCT = 0.03  # of S: the two runs share noise and errors, and differ by the filter alone
SAME_OFFSET_MPS2 = 0.006


def filtered(response: Filter, band: BuildingSpectrum = BROAD, where: str = "sensor") -> tuple[Node, Building]:
    """A node that moves on all axes in this band, one of its instruments with this filter."""
    drawn = node(SEED, all_axes=True, stated=Stated(lag_s=0.01), timing=Timing(20.0, 60.0, WINDOWS))
    parameters = replace(drawn.building.parameters, band=band)
    instrument = replace(getattr(parameters, where), response=response)
    return drawn, Building(replace(parameters, **{where: instrument}), SEED)


def newest(drawn: Node, events: Iterable[Event]) -> CalibrationUpdate:
    """The calibration in force after these events."""
    run, found = Run(drawn.config), None
    for event in events:
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                found = result
    run.close()
    assert found is not None
    return found


@cache
def told(name: str, where: str = "sensor") -> CalibrationUpdate:
    drawn, building = filtered(FILTERS[name], where=where)
    return newest(drawn, visits(building, range(WINDOWS)))


def size(name: str, update: CalibrationUpdate) -> float:
    """|h| at the frequency at which S holds."""
    return float(abs(FILTERS[name](np.array([update.reference_frequency_hz]))[0]))


def deviation_pct(one: CalibrationUpdate, other: Array) -> float:
    return float(100.0 * np.abs(np.array(one.sensitivity) - other).max())


@pytest.mark.two_cases
@pytest.mark.parametrize("name", [name for name in FILTERS if name != "flat"])
def test_a_filter_changes_neither_s_at_its_frequency_nor_q(name):
    found, without = told(name), told("flat")
    assert found.windows == without.windows >= WINDOWS - 1
    assert deviation_pct(found, np.array(without.sensitivity) * size(name, found)) < SAME_PCT
    assert np.abs(np.array(found.offset) - without.offset).max() < SAME_OFFSET_MPS2
    steady = np.array(found.sensitivity_at_0hz.sensitivity)
    u_steady = np.array(found.sensitivity_at_0hz.standard_uncertainty)
    at_0hz = np.array(without.sensitivity_at_0hz.sensitivity)
    assert (np.abs(steady - at_0hz) <= u_steady).all()


@pytest.mark.slow
def test_a_filter_of_the_reference_acts_the_other_way():
    name = "low-pass of order 2, 31 Hz"
    found, without = told(name, "reference"), told("flat")
    assert deviation_pct(found, np.array(without.sensitivity) / size(name, found)) < SAME_PCT


@pytest.mark.two_cases
@pytest.mark.parametrize("name", list(FILTERS))
def test_the_response_is_told_by_frequency(name):
    found = told(name)
    low_hz, high_hz = found.valid_band_hz
    assert low_hz <= found.reference_frequency_hz <= high_hz
    assert len(found.response) >= 4
    scale = np.array(told("flat").sensitivity)
    for band in found.response:
        middle_hz = np.array([np.sqrt(band.low_hz * band.high_hz)])
        expected = scale * abs(FILTERS[name](middle_hz)[0])
        shown = np.abs(np.array(band.sensitivity_re) + 1j * np.array(band.sensitivity_im))
        assert (np.abs(np.diag(shown - expected)) <= np.diag(band.standard_uncertainty)).all()
        assert (np.diag(band.standard_uncertainty) < 0.0025).all()  # a filter changes these by up to 8 %


@pytest.mark.thorough
def test_s_means_the_same_when_the_motion_becomes_wider():
    name = "low-pass of order 1, 31 Hz"
    drawn, calm = filtered(FILTERS[name], BuildingSpectrum(0.5, 6.0))
    _, wild = filtered(FILTERS[name], BuildingSpectrum(0.5, 15.0))
    found = newest(drawn, [*visits(calm, range(4)), *visits(wild, range(4, WINDOWS))])
    assert found.windows >= WINDOWS - 1
    assert found.response[-1].high_hz < 7.0  # the motion above the first band is not used
    drawn, calm = filtered(flat, BuildingSpectrum(0.5, 6.0))
    _, wild = filtered(flat, BuildingSpectrum(0.5, 15.0))
    without = newest(drawn, [*visits(calm, range(4)), *visits(wild, range(4, WINDOWS))])
    assert deviation_pct(found, np.array(without.sensitivity) * size(name, found)) < SAME_PCT


@pytest.mark.slow
def test_windows_at_one_frequency_before_count_as_what_they_are():
    """A first window at 3 Hz knows S there; the response came later."""
    name = "low-pass of order 1, 31 Hz"
    line = BuildingSpectrum(2.9, 3.1, modes=((3.0, 0.01),))
    found, without = (
        newest(drawn, [*visits(narrow, range(3)), *visits(wide, range(3, WINDOWS))])
        for (drawn, narrow), (_, wide) in (
            (filtered(response, line), filtered(response)) for response in (FILTERS[name], flat)
        )
    )
    assert deviation_pct(found, np.array(without.sensitivity) * size(name, found)) < 2.0 * SAME_PCT


@pytest.mark.slow
def test_beside_an_ac_coupled_reference_the_response_is_told_as_beside_another_one():
    """The corner is stated as it is. What the filters do was told as another corner, by 12 of its uncertainties."""
    corner_hz, found, states = 0.05, {}, {}
    for name, coupling, stated in (
        ("dc", flat, {}),
        ("ac", highpass(corner_hz), {"corner_hz": corner_hz, "u_corner_hz": 0.1 * corner_hz}),
    ):
        drawn, building = filtered(lowpass(2, 31.0))
        reference = replace(building.parameters.reference, response=both(lowpass(2, 80.0), coupling))
        building = Building(replace(building.parameters, reference=reference), SEED)
        keys = drawn.stated.keys()
        run = Run(building_config(building, **keys | {"certificate": keys["certificate"] | stated}))
        results = [result for event in visits(building, range(WINDOWS)) for result in run.feed(event)]
        found[name] = [result for result in results if isinstance(result, CalibrationUpdate)][-1]
        states[name] = run.pipeline._channels[0]._estimation.state
        run.close()
    corner = next(q.key for q in states["ac"].quantities if "corner" in q.key)
    value, u = states["ac"].quantity(corner)
    assert abs(value - corner_hz) < 3.0 * u < 0.1 * corner_hz
    assert found["ac"].windows == found["dc"].windows >= WINDOWS - 1
    assert found["ac"].reference_frequency_hz == pytest.approx(found["dc"].reference_frequency_hz, rel=0.05)
    assert deviation_pct(found["ac"], np.array(found["dc"].sensitivity)) < SAME_PCT
    assert len(found["ac"].response) == len(found["dc"].response)


@pytest.mark.slow
def test_a_restored_state_goes_on_bit_for_bit():
    drawn, building = filtered(FILTERS["moving mean of 16 ms"])
    events = list(visits(building, range(5)))
    whole, first = Run(drawn.config), Run(drawn.config)
    expected = [result for event in events for result in whole.feed(event)]
    cut = len(events) // 2
    found = [result for event in events[:cut] for result in first.feed(event)]
    again = Pipeline.restore(drawn.config.model_dump_json(), first.pipeline.snapshot())
    found += [r for event in events[cut:] for r in again.step(event) if not isinstance(r, Acceleration)]
    assert found == expected
    for run in (whole, first):
        run.close()


@pytest.mark.slow
def test_a_calibration_with_its_response_is_recorded_exactly():
    update = told("low-pass of order 2, 31 Hz")
    topic = f"/{update.sensor}/{update.what}"
    assert decode(schema_of(topic), encode(7, update)) == (7, update)
