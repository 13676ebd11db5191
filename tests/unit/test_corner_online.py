"""An AC-coupled reference or sensor on-line: its stated corner is undone, and how far it is off is an unknown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config.knowledge import Certificate, Prior
from agent.core.events import CalibrationUpdate
from calib.signal.known_filters import filter_of
from hw.mcc172 import Mcc172Options
from hw.ni_daqmx import NiOptions
from tests.unit.drawn_recording import CALM, Devices, Recording, in_force, reports, statuses

CORNER_HZ, U_CORNER_HZ = 0.16, 0.016
STATED: dict[str, Any] = {"corner_hz": CORNER_HZ, "u_corner_hz": U_CORNER_HZ}
SECTIONS: dict[str, dict[str, Any]] = {
    "reference": {"certificate": STATED},
    "sensor": {"prior": {"sensitivity": 1.0} | STATED},
}
GAPS = tuple(k for first in (1500, 4700, 9100, 15300) for k in range(first, first + 20))


def drawn(seed: int, of: str, **more: Any) -> Devices:
    corner_hz = CORNER_HZ + U_CORNER_HZ * np.random.default_rng([seed, 3]).normal()
    return Devices(**more | {f"{of}_corner_hz": float(corner_hz)})


def errors(recording: Recording, **sections: Any) -> np.ndarray:
    """(9,) errors of S over u; every window that moved was used, and the status was never HELD."""
    results = recording.through_agent(**sections)
    assert {report.reason for report in reports(results) if not report.used} <= {CALM}
    assert "VALID" in statuses(results)
    assert "HELD" not in statuses(results)
    found = in_force(results)
    return recording.errors_over_u(found.sensitivity, found.covariance, found.determined)


@pytest.mark.two_cases
@pytest.mark.parametrize("bench", [True, False], ids=["bench", "building"])
@pytest.mark.parametrize("of", ["reference", "sensor"])
def test_a_corner_as_uncertain_as_stated_calibrates(of: str, bench: bool) -> None:
    found = np.array([errors(Recording(k, drawn(k, of), bench=bench), **SECTIONS[of]) for k in range(2)])
    assert np.isfinite(found).all()
    # 18 errors a case, those of one recording in common through its angles: u is right when their root mean square is
    # about 1. Without the corner it is 2.5 in the building.
    assert np.sqrt(np.mean(found**2)) < 1.6
    assert np.abs(found).max() < 3.5


# Of a sensor's corner what is left is second order: the product of the corner and of how far it is off, over the square
# of the frequency at which S holds: 0.05 % here.
@pytest.mark.thorough
@pytest.mark.parametrize(("of", "apart"), [("reference", 0.1), ("sensor", 0.6)])
def test_the_result_is_that_of_instruments_without_a_corner(of: str, apart: float) -> None:
    with_corner = errors(Recording(4, drawn(4, of), bench=False), **SECTIONS[of])
    without = errors(Recording(4, Devices(), bench=False))
    assert np.abs(with_corner - without).max() < apart


@pytest.mark.thorough
def test_a_reference_with_gaps_has_an_integral_between_each_two_of_them() -> None:
    devices = drawn(4, "reference")
    whole = errors(Recording(4, devices, bench=False), **SECTIONS["reference"])
    with_gaps = errors(Recording(4, replace(devices, lost=GAPS), bench=False), **SECTIONS["reference"])
    assert np.abs(with_gaps - whole).max() < 0.3


@pytest.mark.thorough
def test_a_velocity_reference_has_one_too() -> None:
    drawings = [drawn(k, "reference", derivatives=1, reference_noise=1e-5) for k in range(2)]
    stated = {"certificate": STATED | {"quantity": "velocity"}}
    found = np.array([errors(Recording(k, of, bench=False), **stated) for k, of in enumerate(drawings)])
    assert np.sqrt(np.mean(found**2)) < 1.6
    assert np.abs(found).max() < 3.5


MCC172 = tuple(line for line in Mcc172Options(rate_hz=3200.0).known_filters if line.startswith("highpass"))
# Its data sheet: -3 dB at 0.78 Hz, so that a motion at 1.6 Hz reads 10.1 % low, and one at 3.2 Hz 2.8 %.
WIDE: dict[str, Any] = {
    "prior": {"sensitivity": 1.0, "u_main_pct": 20.0},
    "gate": {"least_determined": 1, "max_change_main_pct": 30.0, "max_change_transverse_pct": 10.0,
             "max_change_offset": 5.0},
}  # fmt: skip


def beside_an_mcc172(hz: float, corner_hz: float, *, stated: bool) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors (3,) of the main sensitivities, and their U, beside a reference on an MCC 172."""
    coupling = MCC172 if stated else ()
    band_hz = (hz - 0.3, hz + 0.3)
    devices = Devices(reference_corner_hz=corner_hz, band_hz=band_hz, lines=8, reference_filters=coupling)
    recording = Recording(1, devices, bench=False)
    found = in_force(recording.through_agent(**WIDE))
    main, U = np.diag(np.reshape(found.sensitivity, (3, 3))), 2.0 * np.sqrt(np.diag(found.covariance)[[0, 4, 8]])
    return main / np.diag(recording.S) - 1.0, U / main


@pytest.mark.one_case
@pytest.mark.parametrize(("hz", "low"), [(1.6, 0.101), (3.2, 0.028)])
def test_what_the_driver_mcc172_states_is_undone(hz: float, low: float) -> None:
    error, U = beside_an_mcc172(hz, 0.78, stated=False)
    assert error == pytest.approx(1.0 / (1.0 - low) - 1.0, rel=0.2)  # the reference reads low: S is too large
    assert (error > U).all()
    for corner_hz in (0.71, 0.85):  # as uncertain as stated
        error, U = beside_an_mcc172(hz, corner_hz, stated=True)
        assert (np.abs(error) < U).all()
        assert (U < 0.01).all()


def test_what_the_driver_mcc172_states_agrees_with_both_figures_of_the_data_sheet() -> None:
    at_0_78_hz, at_5_2_hz = 20.0 * np.log10(np.abs(filter_of(MCC172[0]).at(np.array([0.78, 5.2]))))
    assert at_0_78_hz == pytest.approx(-3.01, abs=0.01)
    assert -0.1 < at_5_2_hz < -0.09


@pytest.mark.two_cases
@pytest.mark.parametrize("corner_hz", [0.1, 0.5, 1.0])
def test_a_coupling_whose_corner_the_driver_does_not_know_is_in_u(corner_hz: float) -> None:
    options = NiOptions.model_validate({"channels": ["cDAQ1Mod1/ai0"], "iepe_ma": 2.0})
    devices = Devices(reference_corner_hz=corner_hz, band_hz=(2.0, 10.0), reference_filters=options.known_filters)
    recording = Recording(2, devices, bench=False)
    found = in_force(recording.through_agent(**WIDE))
    error = np.diag(np.reshape(found.sensitivity, (3, 3))) - np.diag(recording.S)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(found.covariance)[[0, 4, 8]])).all()  # one of 40 sound runs has more
    assert (np.abs(error) < 0.003).all()


def test_a_corner_that_the_certificate_states_comes_before_that_of_the_driver() -> None:
    filters = ("highpass corner_hz=0.78", "delay delay_s=0.01")
    of_driver = Certificate().with_filters(filters)
    assert (of_driver.corner_hz, of_driver.filters) == (0.78, filters[1:])
    assert of_driver.u_corner_hz == pytest.approx(0.078)
    stated = Certificate(corner_hz=0.2, u_corner_hz=0.01).with_filters(filters)
    assert (stated.corner_hz, stated.u_corner_hz, stated.filters) == (0.2, 0.01, filters[1:])
    assert Prior(filters=("flat",)).with_filters(filters).filters == ("flat",)
    assert Prior(filters=("flat",)).with_filters(filters).corner_hz == 0.78


@pytest.mark.slow
def test_a_corner_that_a_driver_states_anew_makes_s_uncertain_by_as_much() -> None:
    """As after an upgrade: the driver of a reference that reads 10 % low stated nothing, and now it does."""
    devices = Devices(reference_corner_hz=0.78, band_hz=(1.2, 2.0), lines=16, reference_filters=MCC172)
    recording = Recording(1, devices, bench=False)
    results = recording.through_agent(reference_stated_from_s=0.5 * recording.duration_s, **WIDE)
    assert "HELD" not in statuses(results)
    assert {report.reason for report in reports(results) if not report.used} <= {CALM}
    (before, *_), after = [r for r in results if isinstance(r, CalibrationUpdate)], in_force(results)
    error = np.diag(np.reshape(before.sensitivity, (3, 3))) / np.diag(recording.S) - 1.0
    assert error == pytest.approx(0.112, rel=0.2)
    error = np.diag(np.reshape(after.sensitivity, (3, 3))) / np.diag(recording.S) - 1.0
    assert (np.abs(error) < 2.0 * np.sqrt(np.diag(after.covariance)[[0, 4, 8]])).all()
    assert (np.abs(error) < 0.01).all()
