"""A mapping in TOML: which fields of which topics of ROS 2 are time, axes and temperature."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, RootModel, model_validator

from agent.config.reading import ConfigError, load_model
from agent.config.section import Section
from agent.reading.source import Column, TableError
from calib.recorded.units import UNITS, unit_of

TIMES = ("log_time", "publish_time")  # of the message in the MCAP file
CHANNELS = ("x", "y", "z", "a", "v", "d")


def _check_unit(unit: str) -> str:
    if unit_of(unit) is None:
        raise ValueError(f"the unit {unit!r} is not known; known are {', '.join(UNITS)}")
    return unit


Unit = Annotated[str, AfterValidator(_check_unit)]
FieldPath = Annotated[str, Field(max_length=256)]


class Topic(Section):
    """Fields of one topic, as in `linear_acceleration.x` or `samples[2].z`.

    `time`: a field of type Time or a number, or log_time or publish_time. `x`, `y`, `z`: of a sensor, or of a reference
    with three axes. `a`, `v`, `d`: acceleration, velocity or displacement of a reference with one axis. `unit` is that
    of the channels, `time_unit` that of a time that is a number.
    """

    time: FieldPath = "header.stamp"
    time_unit: Unit = "s"
    x: FieldPath | None = None
    y: FieldPath | None = None
    z: FieldPath | None = None
    a: FieldPath | None = None
    v: FieldPath | None = None
    d: FieldPath | None = None
    unit: Unit | None = None
    temperature: FieldPath | None = None

    @model_validator(mode="after")
    def _has_channels(self) -> Topic:
        if not any(getattr(self, name) for name in CHANNELS):
            raise ValueError("no field is named for a channel; state x, y and z, or one of a, v, d")
        return self

    @property
    def paths(self) -> dict[str, str]:
        """The field of each column that is named, the time first."""
        time = "time_s" if self.time_unit == "s" or self.time in TIMES else "time"
        named = {time: self.time} | {name: getattr(self, name) for name in (*CHANNELS, "temperature")}
        return {name: path for name, path in named.items() if path is not None}

    def columns(self, topic: str) -> list[Column]:
        """The columns of the topic."""
        units = dict.fromkeys(CHANNELS, self.unit or "") | {
            "temperature": "degC",
            "time_s": "s",
            "time": self.time_unit,
        }
        return [Column(name, units[name], topic) for name in self.paths]


class Mapping(RootModel[dict[str, Topic]]):
    """One table for each topic: ["/imu/raw"]."""


def read_mapping(path: Path) -> dict[str, Topic]:
    """Read a mapping. Raises TableError with all faults."""
    try:
        return load_model(path, Mapping).root
    except ConfigError as error:
        raise TableError(str(error)) from None
