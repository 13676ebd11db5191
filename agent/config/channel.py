"""One sensor with its reference: geometry, poses, and how its windows are made."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from agent.config.knowledge import Knowledge, Nine
from agent.config.pose import PoseInterval, Stop, tell_apart
from agent.config.section import Name, Vector
from calib.geometry import beside
from calib.model import Pose

# What is left of a pose after its guards. Shorter ones hold nothing to calibrate by; a typo would flood the store.
SHORTEST_POSE_S = 0.1
LEAST_LEANING_DEG = 5.0  # of a clamp whose alpha gravity shall tell: 1 mg of offset is 0.7 deg there


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
    # In place of poses, no times told: the stops in which the sensor may stand, or "free", a clamp at any angles; which
    # of them, and since when, gravity tells. clamp_theta_deg is the clamp's inclination, where it is known.
    positions: Annotated[
        Annotated[tuple[Stop, ...], Tag("stops")] | Annotated[Literal["free"], Tag("free")],
        Discriminator(lambda stated: "free" if isinstance(stated, str) else "stops"),
    ] = ()
    clamp_theta_deg: Annotated[float | None, Field(ge=-90, le=90)] = None

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
            if fault := pose.fault(self.reference is not None):
                raise ValueError(f"poses.{i}: {fault}")
        if self.poses_repeat_s is not None and self.poses_repeat_s < end:
            raise ValueError(f"poses_repeat_s {self.poses_repeat_s} is shorter than the schedule, {end}")
        return self

    @model_validator(mode="after")
    def _found_by_gravity(self) -> Channel:
        if self.clamp_theta_deg is not None and self.positions != "free":
            raise ValueError('clamp_theta_deg goes with positions = "free"')
        if not self.positions:
            return self
        if self.poses or self.poses_repeat_s or self.rotation is not None:
            raise ValueError("positions take the place of poses and of rotation")
        if self.coupling == "ac":
            raise ValueError('positions are found from gravity, which a sensor of coupling "ac" does not feel')
        if self.positions == "free":
            if self.reference is None:
                raise ValueError('positions = "free" is a clamp, which needs a reference')
            if self.clamp_theta_deg is not None and abs(self.clamp_theta_deg) < LEAST_LEANING_DEG:
                raise ValueError(
                    f"clamp_theta_deg {self.clamp_theta_deg}: below {LEAST_LEANING_DEG:g} gravity tells no alpha"
                )
            return self
        if len(self.positions) < 2:
            raise ValueError("positions: one alone leaves nothing to find, state it in poses")
        for i, stop in enumerate(self.positions):
            if fault := stop.fault(self.reference is not None) or stop.hidden:
                raise ValueError(f"positions.{i}: {fault}")
        tell_apart(self.stops)
        return self

    @property
    def stops(self) -> list[Pose]:
        """The positions that were stated."""
        stated = () if self.positions == "free" else self.positions
        return [stop.pose(self.gravity_mps2, self.static_sign, feels_gravity=self.coupling == "dc") for stop in stated]
