"""A node whose faults are drawn once: a building, and a configuration whose stated uncertainties are true for it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agent.config import Config
from benchmarks.online.config import building_config
from hw import adxl355_registers
from hw.virtual import adxl355_twin
from hw.virtual.building import Building, BuildingDevice, BuildingParameters, Weather
from hw.virtual.building_motion import BuildingSpectrum
from hw.virtual.harm import HARMLESS, Harm
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, rotation
from hw.virtual.timebase import Clock

RATE_HZ = 100.0


@dataclass(frozen=True, slots=True)
class Stated:
    """Standard uncertainties that the operator states; the faults are drawn from them.

    They are so small that four or five of them are within max_change. A sensor that differs from its certificate by
    more is held because of that rule, which is not a statistical question.
    """

    main_pct: float = 1.0
    transverse_pct: float = 0.5
    offset_mps2: float = 0.1
    rotation_deg: float = 0.2
    reference_pct: float = 0.1
    lag_s: float = 0.002
    gravity_deg: float = 0.1  # of the mount against the vertical
    gravity_mps2: float = 0.03
    offset_window_mps2: float = 0.002

    def keys(self) -> dict[str, Any]:
        """Sections of the channel. All walks are zero, because neither building nor reference wander."""
        return {
            "prior": {
                "sensitivity": 1.0, "u_main_pct": self.main_pct, "u_transverse_pct": self.transverse_pct,
                "u_offset_mps2": self.offset_mps2,
            },
            "certificate": {"u_sensitivity_pct": self.reference_pct, "stability_pct": 0.0},
            "uncertainty": {
                "rotation_deg": self.rotation_deg, "tilt_deg": self.gravity_deg, "gravity_mps2": self.gravity_mps2,
                "lag_s": self.lag_s, "offset_mps2": self.offset_window_mps2,
            },
            "process": {
                "sensitivity_pct": 0.0, "offset_mps2": 0.0, "offset_rate_mps2": 0.0, "offset_rate_walk_mps2": 0.0,
                "tilt_deg": 0.0,
            },
            "temperature": {"offset_order": 0},
            "gate": {
                # With motion in one direction alone, Q is never known better than the transverse sensitivities.
                "least_determined": 1,
                # The defaults, or five standard uncertainties where a quantity is known less well than the default.
                "max_change_main_pct": max(5.0, 5 * self.main_pct),
                "max_change_transverse_pct": max(3.0, 5 * self.transverse_pct),
                "max_change_rotation_deg": max(3.0, 5 * self.transverse_pct),
                "max_change_offset": max(0.5, 5 * self.offset_mps2),
            },
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Timing:
    """Number and timing of the windows of a run."""

    window_s: float = 20.0
    every_s: float = 60.0
    windows: int = 12


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A building and its configuration."""

    building: Building
    config: Config
    stated: Stated = field(default_factory=Stated)


def adxl355(instrument: BuildingDevice, rate_hz: float) -> BuildingDevice:
    """The instrument as an ADXL355 at this output data rate: with the chip's filters, which its driver states."""
    return replace(
        instrument,
        clock=replace(instrument.clock, nominal_rate_hz=rate_hz),
        response=adxl355_twin.filters(rate_hz),
        filters=adxl355_registers.filters(rate_hz),
    )


def node(
    seed: int,
    *,
    all_axes: bool,
    harm: Harm = HARMLESS,
    harmed_from: int = 0,
    stated: Stated | None = None,
    timing: Timing | None = None,
    transverse: tuple[complex, complex] = (0.0, 0.0),
    chip_hz: float | None = None,
) -> Node:
    """Draw everything from `seed`, at 100 Hz; with `chip_hz` the sensor is an ADXL355 at this output data rate.

    The building moves along all axes independently, or along y. `transverse`: how much of the motion along y there is
    along x and z, in phase (real part) and 90 deg ahead (imaginary part).
    """
    stated, timing = stated or Stated(), timing or Timing()
    random = np.random.default_rng([seed, 5])
    main, across = stated.main_pct / 100, stated.transverse_pct / 100
    gravity = _turned(random, stated.gravity_deg) @ np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
    parameters = BuildingParameters(
        window_s=timing.window_s,
        every_s=timing.every_s,
        band=BuildingSpectrum(0.5, 12.0),
        all_axes=all_axes,
        across=transverse,
        sensitivity=np.eye(3) + np.where(np.eye(3), main, across) * random.standard_normal((3, 3)),
        offset=stated.offset_mps2 * random.standard_normal(3),
        lag_s=stated.lag_s * float(random.standard_normal()),
        rotation=_turned(random, stated.rotation_deg),
        gravity_mps2=gravity * (1 + stated.gravity_mps2 / STANDARD_GRAVITY_MPS2 * random.standard_normal()),
        reference_sensitivity=np.diag(1 + stated.reference_pct / 100 * random.standard_normal(3)),
        weather=Weather(15.0, 0.0, 0.0),
        sensor=BuildingDevice(0.005, Clock(RATE_HZ, 1e-4 * random.standard_normal(), 0.0013, 20e-6)),
        reference=BuildingDevice(0.001, Clock(RATE_HZ, 1e-4 * random.standard_normal(), 0.0004)),
    )
    if chip_hz is not None:
        parameters = replace(parameters, sensor=adxl355(parameters.sensor, chip_hz))
    building = Building(parameters, seed, harm, harmed_from)
    return Node(building, building_config(building, **stated.keys()), stated)


def _turned(random: np.random.Generator, u_deg: float) -> np.ndarray:
    """A small rotation with standard deviation `u_deg` about each axis."""
    vector = np.deg2rad(u_deg) * random.standard_normal(3)
    angle = float(np.linalg.norm(vector))
    return rotation(vector / angle, angle) if angle else np.eye(3)
