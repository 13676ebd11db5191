"""How the sensor may stand: stated for a stretch of time, or one of several stops that gravity tells apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from agent.config.section import Section, Vector
from calib.geometry import along, at_rest, clamp
from calib.model import Pose

# Stops nearer to each other are told apart by nothing that anybody knows of a sensor: 1 deg is 0.17 m/s2 of offset.
LEAST_APART_DEG = 1.0


class Stop(Section):
    """One way in which the sensor can stand.

    One of: theta_deg and alpha_deg (clamp, Eqs. 9-11); direction (unit vector of the motion in the sensor's frame) with
    gravity_mps2 where the sensor feels it; gravity_mps2 alone (a rest; gravity is the excitation). gravity_mps2 is
    what an ideal sensor reads at rest there: +g on the axis that points up.
    """

    theta_deg: Annotated[float | None, Field(ge=-90, le=90)] = None
    alpha_deg: Annotated[float | None, Field(ge=-360, le=360)] = None
    direction: Vector | None = None
    gravity_mps2: Vector | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Stop:
        if (self.theta_deg is None) != (self.alpha_deg is None):
            raise ValueError("theta_deg and alpha_deg go together")
        if self.theta_deg is not None and (self.direction or self.gravity_mps2):
            raise ValueError("theta_deg and alpha_deg exclude direction and gravity_mps2")
        if self.theta_deg is None and self.direction is None and self.gravity_mps2 is None:
            raise ValueError("needs theta_deg and alpha_deg, or direction, or gravity_mps2")
        if self.direction is not None and abs(sum(x * x for x in self.direction) - 1) > 1e-3:
            raise ValueError(f"direction {self.direction} is not a unit vector")
        return self

    @property
    def moves(self) -> bool:
        """Whether there is a motion for a reference to measure."""
        return self.theta_deg is not None or self.direction is not None

    def fault(self, reference: bool) -> str:
        """Why it cannot be of a channel with, or without, a reference; "" where it can."""
        if self.moves and not reference:
            return "needs a reference (only gravity_mps2 alone does without)"
        if reference and not self.moves:
            return "a rest (gravity_mps2 alone) is for a channel without a reference"
        return ""

    @property
    def hidden(self) -> str:
        """Why gravity cannot tell that a sensor stands here; "" where it can."""
        if self.theta_deg is None and (self.gravity_mps2 is None or not any(self.gravity_mps2)):
            return "gravity_mps2 is needed, by which it is found"
        return ""

    def pose(self, gravity_mps2: float, static_sign: int, *, feels_gravity: bool) -> Pose:
        """What is stated, for a sensor that feels gravity or does not."""
        if self.theta_deg is not None and self.alpha_deg is not None:
            theta_rad, alpha_rad = np.deg2rad(self.theta_deg), np.deg2rad(self.alpha_deg)
            return clamp(float(theta_rad), float(alpha_rad), gravity_mps2 if feels_gravity else 0.0, static_sign)
        if self.direction is not None:
            return along(self.direction, self.gravity_mps2 if feels_gravity else (0.0, 0.0, 0.0))
        assert self.gravity_mps2 is not None  # the validator allows no other form
        return at_rest(self.gravity_mps2)


class PoseInterval(Stop):
    """How the sensor stands between two times, in seconds since the sensor's first sample."""

    start_s: Annotated[float, Field(ge=0)]
    stop_s: Annotated[float, Field(gt=0)]

    @model_validator(mode="after")
    def _ends_after_it_begins(self) -> PoseInterval:
        if self.stop_s <= self.start_s:
            raise ValueError(f"stop_s {self.stop_s} is not after start_s {self.start_s}")
        return self


def tell_apart(stops: Sequence[Pose]) -> None:
    """Raises ValueError, naming both, where gravity does not tell two stops from each other."""
    for i, stop in enumerate(stops):
        for k, other in enumerate(stops[:i]):
            between = stop.gravity_mps2 / np.linalg.norm(stop.gravity_mps2)
            apart = np.linalg.norm(between - other.gravity_mps2 / np.linalg.norm(other.gravity_mps2))
            if not apart >= np.deg2rad(LEAST_APART_DEG):
                raise ValueError(
                    f"positions.{k} and positions.{i} have the same gravity to {np.degrees(apart):.2g} deg: nothing "
                    "tells which of them the sensor stands in"
                )
