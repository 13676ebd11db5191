"""One sensor with its reference: geometry, poses, and how its windows are made."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import time
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, FailFast, Field, Tag, field_validator, model_validator

from agent.config.knowledge import Certificate, Knowledge, Nine, Positive
from agent.config.pose import PoseInterval, Stop, tell_apart
from agent.config.section import Name, Section, Vector
from calib.geometry import UNIT_TOLERANCE
from calib.model import Pose

# Least length of a pose after its guards are taken off. A shorter pose cannot be used, and many of them, after a typing
# error, would fill the store.
SHORTEST_POSE_S = 0.1
LEAST_BAND = 2.0  # the upper end of a band over the lower one: four third octaves, as calib.windows.bands asks for
LEAST_LEANING_DEG = 5.0  # of a clamp, if alpha is found from gravity: 1 mg of offset is 0.7 deg of alpha there


FEWEST_DISMISSING = 3  # of two references one may have two windows in a row


def check_rotation(name: str, stated: Nine) -> None:
    """Check that nine numbers, row by row, are a rotation. Raises ValueError, which begins with the name."""
    R = np.reshape(stated, (3, 3))
    left, _, right = np.linalg.svd(R)
    nearest = left @ right
    if np.linalg.det(nearest) < 0.0:
        raise ValueError(
            f"{name}: {list(stated)} is left-handed: an axis has the wrong sign, or two are exchanged; change the sign "
            "of one row or column, as the sensor is mounted"
        )
    if (off := float(np.abs(R @ R.T - np.eye(3)).max())) > UNIT_TOLERANCE:
        told = ", ".join(f"{x:.5g}" for x in np.round(nearest.ravel(), 5) + 0.0)
        raise ValueError(
            f"{name}: its rows must have the length 1 and right angles between them, and are off by {off:.2g} (limit "
            f"{UNIT_TOLERANCE:g}); correct it, or state more digits: the nearest rotation is [{told}]"
        )


class CheckReference(Section):
    """A second reference: its device, its own certificate, and `rotation` if its axes are turned from the first's."""

    device: Name
    certificate: Certificate = Certificate()
    rotation: Nine | None = None


class SelfTestPlan(Section):
    """The self-test of the sensor, each day. Left out, none runs: the sensor sends nothing for about 15 s, and beside a
    reference its lag is found anew afterwards.

    The supply voltage is not measured. Its relative standard uncertainty from one day to another, `u_supply_pct`, is by
    default that of a regulator whose maker states 2 % over load, line and temperature.
    """

    at: Annotated[time, Field(description='time of day in UTC, such as "03:00"; when little moves')]
    most_motion_mps2: Annotated[
        Positive,
        Field(description="standard deviation of 10 s of samples above which it waits, for an hour at most"),
    ] = 0.1
    u_supply_pct: Annotated[float, Field(ge=0, le=10)] = 1.0

    @field_validator("at")
    @classmethod
    def _is_utc(cls, value: time) -> time:
        if value.tzinfo is not None:
            raise ValueError("at is a time of UTC without a zone, such as 03:00")
        return value


class Channel(Knowledge):
    """One sensor with its reference and its geometry."""

    sensor: Name
    # Left out, with neither poses nor positions: the sensor is watched, and keeps the calibration that it has.
    reference: Name | None = None
    check_reference: CheckReference | None = None
    coupling: Literal["dc", "ac"] = "dc"
    gravity_mps2: Annotated[float, Field(gt=9.7, lt=9.9)] = 9.80665
    static_sign: Literal[1, -1] = 1
    # After a clamp was turned by hand it vibrates for about a second: half a second at each end of a pose is not used.
    guard_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    # Lowest and highest frequency of the motion from which S and the response are estimated. Motion more than a tenth
    # above is filtered out. Left out, the first windows settle it.
    band_hz: tuple[Positive, Positive] | None = None
    # Longest delay of samples. They are kept as long, in memory and in every snapshot: 29 MB for a minute of six axes
    # at 10 kHz.
    late_horizon_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    silence_s: Annotated[
        float, Field(gt=0, le=3600, description="after this time without data the status is INVALID")
    ] = 5.0
    # Length of a window. A longer interval is cut into windows, so that memory stays limited and results come
    # regularly.
    window_s: Annotated[float, Field(ge=1, le=600)] = 60.0
    every_s: Annotated[
        float, Field(ge=0, le=86400, description="time from window to window; 0: no time between windows")
    ] = 0.0
    # The corrected stream, a = S^-1 (V - Q) with its uncertainty, can be published ("publish") or recorded too
    # ("record").
    acceleration: Literal["off", "publish", "record"] = "off"
    # With a tri-axial reference beside the sensor no poses are needed: a = R a_ref, R row by row. rotation_gravity_mps2
    # is gravity in the sensor's frame; state it only if the reference is AC-coupled.
    rotation: Nine | None = None
    rotation_gravity_mps2: Vector | None = (0.0, 0.0, 0.0)
    poses: Annotated[tuple[PoseInterval, ...], FailFast()] = ()  # a day may have 86,400; the first fault is told
    poses_repeat_s: Annotated[float | None, Field(gt=0)] = None
    # Instead of poses, without times: the stops in which the sensor may be, or "free" for a clamp at any angles. The
    # agent finds the position and its time from gravity. clamp_theta_deg is the inclination of the clamp, if it is
    # known.
    positions: Annotated[
        Annotated[tuple[Stop, ...], Tag("stops")] | Annotated[Literal["free"], Tag("free")],
        Discriminator(lambda stated: "free" if isinstance(stated, str) else "stops"),
    ] = ()
    clamp_theta_deg: Annotated[float | None, Field(ge=-90, le=90)] = None

    # Off unless stated, also without a reference: only people know when little moves, and whether samples may lack.
    self_test: SelfTestPlan | None = None

    @property
    def fixed_mount(self) -> bool:
        """Whether the sensor is never turned against gravity. Its mean output then gives no information on S."""
        return self.rotation is not None or len(self.poses) == 1

    @property
    def watched(self) -> bool:
        """Whether neither a reference nor a stated position can calibrate the sensor: it is recorded and watched."""
        return self.reference is None and not self.poses and not self.positions

    @property
    def by_reference(self) -> list[Channel]:
        """The channel as it is beside each of its references: itself, then the one beside the second reference."""
        check = self.check_reference
        if check is None:
            return [self]
        other = {
            "reference": check.device,
            "certificate": check.certificate,
            "rotation": check.rotation or self.rotation,
        }
        return [self, self.model_copy(update=other)]

    def with_filters_of(self, drivers: Mapping[str, tuple[str, ...]]) -> Channel:
        """The channel with the filters that drivers state, by device, where the configuration states none."""
        filled: dict[str, Section] = {
            "prior": self.prior.with_filters(drivers.get(self.sensor, ())),
            "certificate": self.certificate.with_filters(drivers.get(self.reference or "", ())),
        }
        if (check := self.check_reference) is not None:
            certificate = check.certificate.with_filters(drivers.get(check.device, ()))
            filled["check_reference"] = check.model_copy(update={"certificate": certificate})
        return self.model_copy(update=filled)

    @model_validator(mode="after")
    def _second_reference(self) -> Channel:
        check = self.check_reference
        if check is None:
            return self
        if self.reference is None:
            raise ValueError("check_reference is a second reference; name the first one in reference")
        if check.rotation is not None and self.rotation is None:
            raise ValueError("check_reference.rotation needs rotation of the first reference; add that, or remove it")
        if check.rotation is not None:
            check_rotation("check_reference.rotation", check.rotation)
        if self.gate.dismiss_windows < FEWEST_DISMISSING:
            raise ValueError(
                f"gate.dismiss_windows {self.gate.dismiss_windows}: with check_reference it must be "
                f"{FEWEST_DISMISSING} or more, so that sound windows of one reference do not dismiss those of the other"
            )
        if fault := self.by_reference[1].certificate_fault:
            raise ValueError(f"check_reference: {fault}")
        return self

    @model_validator(mode="after")
    def _band(self) -> Channel:
        if self.band_hz is None:
            return self
        low_hz, high_hz = self.band_hz
        if self.reference is None:
            raise ValueError("band_hz is that of a motion, which needs a reference; name one, or remove band_hz")
        if high_hz < LEAST_BAND * low_hz:
            raise ValueError(
                f"band_hz [{low_hz:g}, {high_hz:g}] is too narrow to tell a response over frequency; state the lower "
                f"frequency first, and a second one that is at least {LEAST_BAND:g} times as high, or remove band_hz"
            )
        at_hz = self.prior.reference_frequency_hz
        if at_hz and not low_hz <= at_hz <= high_hz:
            raise ValueError(
                f"prior.reference_frequency_hz {at_hz:g} is not within band_hz [{low_hz:g}, {high_hz:g}]; change one "
                "of the two"
            )
        return self

    @model_validator(mode="after")
    def _schedule(self) -> Channel:
        if self.rotation is not None:
            if self.poses or self.reference is None:
                raise ValueError(
                    "rotation is for a channel with a tri-axial reference and without "
                    "poses; remove poses, or name the reference"
                )
            check_rotation("rotation", self.rotation)
        if self.every_s and self.every_s < self.window_s:
            raise ValueError(f"every_s {self.every_s} is shorter than window_s {self.window_s}; make it longer, or 0")
        end = 0.0
        for i, pose in enumerate(self.poses):
            if pose.start_s < end:
                raise ValueError(
                    f"poses.{i}.start_s {pose.start_s} is before the end of the "
                    f"previous pose, {end}; poses must not overlap"
                )
            end = pose.stop_s
            if pose.stop_s - pose.start_s - 2 * self.guard_s < SHORTEST_POSE_S:
                raise ValueError(
                    f"poses.{i}: too short: without guard_s {self.guard_s} at both "
                    f"ends, less than {SHORTEST_POSE_S} s is left"
                )
            if fault := pose.fault(self.reference is not None):
                raise ValueError(f"poses.{i}: {fault}")
        if self.poses_repeat_s is not None and self.poses_repeat_s < end:
            raise ValueError(f"poses_repeat_s {self.poses_repeat_s} is shorter than the poses, which end at {end}")
        return self

    def _check_clamp(self) -> None:
        if self.reference is None:
            raise ValueError('positions = "free" is for a clamp, so it needs a reference; name one')
        if self.clamp_theta_deg is not None and abs(self.clamp_theta_deg) < LEAST_LEANING_DEG:
            raise ValueError(
                f"clamp_theta_deg {self.clamp_theta_deg}: gravity cannot show alpha below {LEAST_LEANING_DEG:g} deg"
            )

    @model_validator(mode="after")
    def _found_by_gravity(self) -> Channel:
        if self.clamp_theta_deg is not None and self.positions != "free":
            raise ValueError('clamp_theta_deg needs positions = "free"; set that, or remove clamp_theta_deg')
        if not self.positions:
            return self
        if self.poses or self.poses_repeat_s or self.rotation is not None:
            raise ValueError("give only one of positions, poses and rotation (poses_repeat_s belongs to poses)")
        if self.coupling == "ac":
            raise ValueError(
                'positions are found from gravity, which a sensor with coupling = "ac" does not measure; give poses'
            )
        if self.positions == "free":
            self._check_clamp()
            return self
        if len(self.positions) < 2:
            raise ValueError("positions: there is only one, so there is nothing to find; state it in poses instead")
        for i, stop in enumerate(self.positions):
            if fault := stop.fault(self.reference is not None) or stop.hidden:
                raise ValueError(f"positions.{i}: {fault}")
        tell_apart(self.stops)
        return self

    @property
    def stops(self) -> list[Pose]:
        """The stated positions."""
        stated = () if self.positions == "free" else self.positions
        return [stop.pose(self.gravity_mps2, self.static_sign, feels_gravity=self.coupling == "dc") for stop in stated]
