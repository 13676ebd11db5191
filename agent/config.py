"""The configuration: one TOML file, checked wholly before anything starts, every fault named at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ByteSize, ConfigDict, Field, ValidationError, model_validator

from calib.geometry import beside
from hw.sensor import DeviceError, load_driver

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$", description="a chunk of a Zenoh key")]
Endpoint = Annotated[str, Field(pattern=r"^[^/]+/.+$", description="of a Zenoh router: tcp/192.0.2.1:7447")]
Vector = tuple[float, float, float]
# What is left of a pose after its guards. Shorter ones hold nothing to calibrate by; a typo would flood the store.
SHORTEST_POSE_S = 0.1
LARGEST_FILE = 4 << 20  # bytes; a day of a pose each second has as many


class Section(BaseModel):
    """Base of all sections: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Gateway(Section):
    """Who this gateway is: the first chunks of every Zenoh key."""

    site: Name = "site"
    name: Name = "gateway"


class Device(Section):
    """One device and its driver. The driver checks its own options."""

    name: Name
    driver: str
    options: dict[str, Any] = {}


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


class Channel(Section):
    """One sensor with its reference and its geometry."""

    sensor: Name
    reference: Name | None = None
    reference_quantity: Literal["acceleration", "velocity"] = "acceleration"
    reference_sensitivity: Annotated[float, Field(gt=0, description="indication per m/s2, or per m/s")] = 1.0
    coupling: Literal["dc", "ac"] = "dc"
    gravity_mps2: Annotated[float, Field(gt=9.7, lt=9.9)] = 9.80665
    static_sign: Literal[1, -1] = 1
    # Turning a clamp by hand ends in a second of ringing and of fingers leaving; half a second each side is unused.
    guard_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    # Samples wait as long, in memory and in every snapshot: a minute of 10 kHz on six axes is 29 MB.
    late_horizon_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    silence_s: Annotated[float, Field(gt=0, le=3600, description="without a block the status is INVALID")] = 5.0
    windows: Annotated[int, Field(ge=1, le=200, description="how many of the newest windows the solution uses")] = 24
    # A tri-axial reference beside the sensor needs no poses: a = R a_ref, R row by row. What the sensor reads at rest
    # belongs here only where the reference is AC-coupled.
    rotation: tuple[float, float, float, float, float, float, float, float, float] | None = None
    rotation_gravity_mps2: Vector | None = (0.0, 0.0, 0.0)
    poses: tuple[PoseInterval, ...] = ()
    poses_repeat_s: Annotated[float | None, Field(gt=0)] = None

    @model_validator(mode="after")
    def _schedule(self) -> Channel:
        if self.rotation is not None:
            if self.poses or self.reference is None:
                raise ValueError("rotation is for a tri-axial reference and takes the place of poses")
            beside([self.rotation[i : i + 3] for i in (0, 3, 6)])
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


class Recording(Section):
    """Where and how raw data are kept."""

    rotate_s: Annotated[float, Field(ge=1, le=86400)] = 3600.0
    rotate_bytes: Annotated[ByteSize, Field(ge=1 << 20)] = ByteSize(256 * 1024 * 1024)
    # At most this much is lost to a power cut; facts: 2 s costs 11 % more disk than no flush.
    flush_s: Annotated[float, Field(gt=0, le=5)] = 2.0


class Zenoh(Section):
    """How results leave."""

    enabled: bool = True
    connect: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)


class Config(Section):
    """All of it."""

    gateway: Gateway = Gateway()
    devices: Annotated[tuple[Device, ...], Field(min_length=1)]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1)]
    recording: Recording = Recording()
    zenoh: Zenoh = Zenoh()

    @model_validator(mode="after")
    def _names(self) -> Config:
        names = [d.name for d in self.devices]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"devices: the name {name!r} is used more than once")
        sensors = [c.sensor for c in self.channels]
        for i, channel in enumerate(self.channels):
            for role, device in (("sensor", channel.sensor), ("reference", channel.reference)):
                if device is not None and device not in names:
                    known = ", ".join(names)
                    raise ValueError(f"channels.{i}.{role}: no device is called {device!r}; there are {known}")
            if channel.reference == channel.sensor:
                raise ValueError(f"channels.{i}: a sensor cannot be its own reference")
            if sensors.count(channel.sensor) > 1:
                raise ValueError(f"channels.{i}.sensor: {channel.sensor!r} has more than one channel")
        return self


class ConfigError(Exception):
    """The faults of a configuration, one line each, every one with file, path and value."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


def load_config(path: Path) -> Config:
    """Read and check a TOML file. Raises ConfigError with all faults."""
    try:
        with open(path, "rb") as file:
            text = file.read(LARGEST_FILE + 1).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]) from None
    if len(text) > LARGEST_FILE:
        raise ConfigError([f"{path}: more than {LARGEST_FILE} bytes, no configuration"])
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"{path}: not TOML: {error}"]) from None
    return parse_config(raw, str(path))


def parse_config(raw: dict[str, Any], origin: str) -> Config:
    """Check what a TOML file held; `origin` names it in the faults."""
    faults: list[str] = []
    config = None
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        faults += [f"{origin}: {line}" for line in _fault_lines(error)]
    devices = raw.get("devices")
    for i, device in enumerate(devices if isinstance(devices, list) else []):
        if isinstance(device, dict):
            faults += [f"{origin}: devices.{i}.{line}" for line in _driver_faults(device)]
    if faults or config is None:
        raise ConfigError(faults)
    return config


def _driver_faults(device: dict[str, Any]) -> list[str]:
    driver, options = device.get("driver"), device.get("options", {})
    if not isinstance(driver, str) or not isinstance(options, dict):
        return []  # the section's own check names it
    try:
        load_driver(driver).options_model.model_validate(options)
    except DeviceError as error:
        return [f"driver: {error}"]
    except ValidationError as error:
        return [f"options.{line}" for line in _fault_lines(error)]
    return []


def _fault_lines(error: ValidationError) -> list[str]:
    lines, faults = [], error.errors()
    places = [fault["loc"] for fault in faults]
    for fault in faults:
        # A list that is too short only because what is in it was refused is no fault of its own.
        if fault["type"] == "too_short" and any(
            len(p) > len(fault["loc"]) and p[: len(fault["loc"])] == fault["loc"] for p in places
        ):
            continue
        path = ".".join(str(part) for part in fault["loc"])
        value = fault.get("input")
        # A whole section as "the offending value" would bury the message.
        whole = isinstance(value, (dict, BaseModel, list, tuple)) or fault["type"] == "missing"
        shown = "" if whole else f", not {value!r}"
        message = fault["msg"].removeprefix("Value error, ")
        lines.append(f"{path}: {message}{shown}" if path else message)
    return lines
