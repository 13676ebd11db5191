"""One sensor with its reference: geometry, poses, and how its windows are made."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from agent.config.knowledge import Knowledge, Nine
from agent.config.section import Name, Section, Vector
from calib.geometry import beside

# What is left of a pose after its guards. Shorter ones hold nothing to calibrate by; a typo would flood the store.
SHORTEST_POSE_S = 0.1


class PoseInterval(Section):
    """How the sensor stands between two times, in seconds since the sensor's first sample.

    One of: theta_deg and alpha_deg (clamp, Eqs. 9-11); direction (unit vector of the motion in the sensor's frame) with
    gravity_mps2 where the sensor feels it; gravity_mps2 alone (a rest; gravity is the excitation). gravity_mps2 is
    what an ideal sensor reads at rest there: +g on the axis that points up.
    """

    start_s: Annotated[float, Field(ge=0)]
    stop_s: Annotated[float, Field(gt=0)]
    theta_deg: Annotated[float | None, Field(ge=-90, le=90)] = None
    alpha_deg: Annotated[float | None, Field(ge=-360, le=360)] = None
    direction: Vector | None = None
    gravity_mps2: Vector | None = None

    @model_validator(mode="after")
    def _one_form(self) -> PoseInterval:
        if self.stop_s <= self.start_s:
            raise ValueError(f"stop_s {self.stop_s} is not after start_s {self.start_s}")
        if (self.theta_deg is None) != (self.alpha_deg is None):
            raise ValueError("theta_deg and alpha_deg go together")
        if self.theta_deg is not None and (self.direction or self.gravity_mps2):
            raise ValueError("theta_deg and alpha_deg exclude direction and gravity_mps2")
        if self.theta_deg is None and self.direction is None and self.gravity_mps2 is None:
            raise ValueError("needs theta_deg and alpha_deg, or direction, or gravity_mps2")
        if self.direction is not None and abs(sum(x * x for x in self.direction) - 1) > 1e-3:
            raise ValueError(f"direction {self.direction} is not a unit vector")
        return self


class Channel(Knowledge):
    """One sensor with its reference and its geometry."""

    sensor: Name
    reference: Name | None = None
    coupling: Literal["dc", "ac"] = "dc"
    gravity_mps2: Annotated[float, Field(gt=9.7, lt=9.9)] = 9.80665
    static_sign: Literal[1, -1] = 1
    # Turning a clamp by hand ends in a second of ringing and of fingers leaving; half a second each side is unused.
    guard_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    # Samples wait as long, in memory and in every snapshot: a minute of 10 kHz on six axes is 29 MB.
    late_horizon_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    silence_s: Annotated[float, Field(gt=0, le=3600, description="without a block the status is INVALID")] = 5.0
    # A long stretch is cut into windows of this length, so that memory stays bounded and news comes.
    window_s: Annotated[float, Field(ge=1, le=600)] = 60.0
    every_s: Annotated[float, Field(ge=0, le=86400, description="one window each; 0: one after the other")] = 0.0
    # Each block corrected, a = S^-1 (V - Q) with its uncertainty: published, or recorded as well.
    acceleration: Literal["off", "publish", "record"] = "off"
    # A tri-axial reference beside the sensor needs no poses: a = R a_ref, R row by row. What the sensor reads at rest
    # belongs here only where the reference is AC-coupled.
    rotation: Nine | None = None
    rotation_gravity_mps2: Vector | None = (0.0, 0.0, 0.0)
    poses: tuple[PoseInterval, ...] = ()
    poses_repeat_s: Annotated[float | None, Field(gt=0)] = None

    @property
    def fixed_mount(self) -> bool:
        """Whether the sensor never turns against gravity: its mean output then tells nothing of S."""
        return self.rotation is not None or len(self.poses) == 1

    @model_validator(mode="after")
    def _schedule(self) -> Channel:
        if self.rotation is not None:
            if self.poses or self.reference is None:
                raise ValueError("rotation is for a tri-axial reference and takes the place of poses")
            beside([self.rotation[i : i + 3] for i in (0, 3, 6)])
        if self.every_s and self.every_s < self.window_s:
            raise ValueError(f"every_s {self.every_s} is shorter than window_s {self.window_s}")
        end = 0.0
        for i, pose in enumerate(self.poses):
            if pose.start_s < end:
                raise ValueError(f"poses.{i}.start_s {pose.start_s} lies before the end of the pose before, {end}")
            end = pose.stop_s
            if pose.stop_s - pose.start_s - 2 * self.guard_s < SHORTEST_POSE_S:
                raise ValueError(
                    f"poses.{i}: less than {SHORTEST_POSE_S} s is left of it after guard_s {self.guard_s} on both sides"
                )
            if self.reference is None and (pose.theta_deg is not None or pose.direction is not None):
                raise ValueError(f"poses.{i} needs a reference (only gravity_mps2 alone does without)")
            if self.reference is not None and pose.theta_deg is None and pose.direction is None:
                raise ValueError(f"poses.{i}: a rest (gravity_mps2 alone) is for a channel without a reference")
        if self.poses_repeat_s is not None and self.poses_repeat_s < end:
            raise ValueError(f"poses_repeat_s {self.poses_repeat_s} is shorter than the schedule, {end}")
        return self
