"""Positions of the sensor: stated for an interval of time, or several stops that the agent tells apart by gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from agent.config.section import Section, Vector
from calib.geometry import along, at_rest, clamp
from calib.model import Pose

# Smallest angle between the directions of gravity at two stops. At 1 deg they differ by 0.17 m/s2, and the offset of a
# sensor is not known better than that.
LEAST_APART_DEG = 1.0

LATEST_S = 1e9  # s, 30 years; with later times the start of the next window could not be told from this one's


class Stop(Section):
    """One position of the sensor. Give one of three forms:

    theta_deg and alpha_deg (clamp, Eqs. 9-11 of the paper); direction (unit vector of the motion in the sensor's
    frame), with gravity_mps2 where the sensor feels gravity; gravity_mps2 alone (a rest: gravity is the excitation).
    gravity_mps2 is what an ideal sensor reads at rest in this position: +g on the axis that points up.
    """

    theta_deg: Annotated[float | None, Field(ge=-90, le=90)] = None
    alpha_deg: Annotated[float | None, Field(ge=-360, le=360)] = None
    direction: Vector | None = None
    gravity_mps2: Vector | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Stop:
        if (self.theta_deg is None) != (self.alpha_deg is None):
            raise ValueError("theta_deg and alpha_deg must be given together")
        if self.theta_deg is not None and (self.direction or self.gravity_mps2):
            raise ValueError("give theta_deg and alpha_deg, or direction and gravity_mps2, not both")
        if self.theta_deg is None and self.direction is None and self.gravity_mps2 is None:
            raise ValueError("needs theta_deg and alpha_deg, or direction, or gravity_mps2")
        if self.direction is not None and abs(sum(x * x for x in self.direction) - 1) > 1e-3:
            length = sum(x * x for x in self.direction) ** 0.5
            unit = ", ".join(f"{x / length if length else 0.0:.5g}" for x in self.direction)
            raise ValueError(f"direction {self.direction} is not a unit vector; divide it by its length: [{unit}]")
        return self

    @property
    def moves(self) -> bool:
        """Whether the position has a motion, which a reference measures."""
        return self.theta_deg is not None or self.direction is not None

    def fault(self, reference: bool) -> str:
        """Why the position does not suit a channel with a reference (or without one); "" where it does."""
        if self.moves and not reference:
            return "a position with motion needs a reference; without a reference, give gravity_mps2 alone (a rest)"
        if reference and not self.moves:
            return "a rest (gravity_mps2 alone) is only for a channel without a reference; give direction too"
        return ""

    @property
    def hidden(self) -> str:
        """Why the agent cannot find this position by gravity; "" where it can."""
        if self.theta_deg is None and (self.gravity_mps2 is None or not any(self.gravity_mps2)):
            return "needs gravity_mps2 other than zero, by which the agent finds this position"
        return ""

    def pose(self, gravity_mps2: float, static_sign: int, *, feels_gravity: bool) -> Pose:
        """The pose of the sensor in this position.

        `gravity_mps2`: local gravity. `static_sign`: sign of gravity in Eqs. (9)-(11). Without `feels_gravity` (an
        AC-coupled sensor) its gravity is zero.
        """
        if self.theta_deg is not None and self.alpha_deg is not None:
            theta_rad, alpha_rad = np.deg2rad(self.theta_deg), np.deg2rad(self.alpha_deg)
            return clamp(float(theta_rad), float(alpha_rad), gravity_mps2 if feels_gravity else 0.0, static_sign)
        if self.direction is not None:
            return along(self.direction, self.gravity_mps2 if feels_gravity else (0.0, 0.0, 0.0))
        assert self.gravity_mps2 is not None  # the validator allows no other form
        return at_rest(self.gravity_mps2)


class PoseInterval(Stop):
    """The sensor's position between two times, in seconds since the sensor's first sample."""

    start_s: Annotated[float, Field(ge=0, le=LATEST_S)]
    stop_s: Annotated[float, Field(gt=0, le=LATEST_S)]

    @model_validator(mode="after")
    def _ends_after_it_begins(self) -> PoseInterval:
        if self.stop_s <= self.start_s:
            raise ValueError(f"stop_s {self.stop_s} is not after start_s {self.start_s}")
        return self


def tell_apart(stops: Sequence[Pose]) -> None:
    """Check that gravity differs between all stops. Raises ValueError, which names two stops where it does not."""
    for i, stop in enumerate(stops):
        for k, other in enumerate(stops[:i]):
            between = stop.gravity_mps2 / np.linalg.norm(stop.gravity_mps2)
            apart = np.linalg.norm(between - other.gravity_mps2 / np.linalg.norm(other.gravity_mps2))
            if not apart >= np.deg2rad(LEAST_APART_DEG):
                raise ValueError(
                    f"gravity at positions.{k} and positions.{i} differs by {np.degrees(apart):.2g} deg only: the "
                    f"agent cannot tell which of them the sensor is in; at least {LEAST_APART_DEG:g} deg are needed"
                )
