"""An AC-coupled reference or sensor on-line: its stated corner is undone, and how far it is off is an unknown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config import ConfigError, parse_config
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
    return replace(Devices(**more), **{f"{of}_corner_hz": float(corner_hz)})


def errors(recording: Recording, **sections: Any) -> np.ndarray:
    """(9,) errors of S over u; every window that moved was used, and the status was never HELD."""
    results = recording.through_agent(**sections)
    assert {report.reason for report in reports(results) if not report.used} <= {CALM}
    assert "VALID" in statuses(results)
    assert "HELD" not in statuses(results)
    found = in_force(results)
    return recording.errors_over_u(found.sensitivity, found.covariance, found.determined)


@pytest.mark.parametrize("bench", [True, False], ids=["bench", "building"])
@pytest.mark.parametrize("of", ["reference", "sensor"])
def test_a_corner_as_uncertain_as_stated_calibrates(of: str, bench: bool) -> None:
    found = np.array([errors(Recording(k, drawn(k, of), bench=bench), **SECTIONS[of]) for k in range(3)])
    assert np.isfinite(found).all()
    # 27 errors a case, those of one recording in common through its angles: u is right when their root mean square is
    # about 1. Without the corner it is 2.5 in the building.
    assert np.sqrt(np.mean(found**2)) < 1.6
    assert np.abs(found).max() < 3.5


# Of a sensor's corner what is left is second order: the product of the corner and of how far it is off, 0.03 % here.
@pytest.mark.parametrize(("of", "apart"), [("reference", 0.1), ("sensor", 0.4)])
def test_the_result_is_that_of_instruments_without_a_corner(of: str, apart: float) -> None:
    with_corner = errors(Recording(4, drawn(4, of), bench=False), **SECTIONS[of])
    without = errors(Recording(4, Devices(), bench=False))
    assert np.abs(with_corner - without).max() < apart


def test_a_reference_with_gaps_has_an_integral_between_each_two_of_them() -> None:
    devices = drawn(4, "reference")
    whole = errors(Recording(4, devices, bench=False), **SECTIONS["reference"])
    with_gaps = errors(Recording(4, replace(devices, lost=GAPS), bench=False), **SECTIONS["reference"])
    assert np.abs(with_gaps - whole).max() < 0.3


def test_a_velocity_reference_has_no_corner() -> None:
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": 100}} for n in "sr"]
    channel = {"sensor": "s", "reference": "r", "prior": {"sensitivity": 1.0}}
    certificate = STATED | {"quantity": "velocity"}
    with pytest.raises(ConfigError, match="a velocity reference has no corner frequency to undo"):
        parse_config({"devices": devices, "channels": [channel | {"certificate": certificate}]}, "")
