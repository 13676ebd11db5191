"""Driver `serial-csv`: a device that writes one sample per line, `[seq,]x,y,z` or `[seq,]a`, on a serial port."""

from __future__ import annotations

import math
from typing import Literal

import serial
from pydantic import Field

from hw.block import DeviceInfo
from hw.cutting import Cutter
from hw.line_stream import LineStream
from hw.serial_sensor import LONGEST_GAP_S, Filters, SerialOptions, SerialSensor
from hw.units import Unit, asked_of_certificate, nominal_sensitivity, tells_sensitivity


class SerialCsvOptions(SerialOptions):
    """Options of `serial-csv`."""

    axes: Literal[1, 3] = Field(3, description="1: uniaxial device, 3: x,y,z")
    rate_hz: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="nominal rate of the samples")
    sequence: bool = Field(
        False, description="each line begins with a sample counter; without it lost lines are not noticed"
    )
    unit: Unit = Field("m/s2", description="of the indications")
    full_scale: float | None = Field(None, gt=0, description="indications of this size or more are saturated")
    serial_number: str = Field("", description="of the device, as on its label")
    filters: Filters = ()

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the user states them."""
        return self.filters

    @property
    def tells_sensitivity(self) -> bool:
        """Whether it indicates m/s2 or g: nothing else is known of such a device."""
        return tells_sensitivity(self.unit)

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)


class SerialCsv(SerialSensor):
    """Bad lines are counted and skipped; a jump in the sequence number is a gap."""

    options_model = SerialCsvOptions

    def _build_stream(self, name: str) -> LineStream:
        options = self._options
        limit = options.full_scale or math.inf
        return LineStream(
            Cutter(name, options.rate_hz, -limit, limit),
            options.axes,
            sequence=options.sequence,
            longest_gap=LONGEST_GAP_S * options.rate_hz,
        )

    def _set_up(self, port: serial.Serial) -> DeviceInfo:  # noqa: ARG002 - such a device has no settings
        options = self._options
        return self._info(
            "serial-csv",
            {"sequence": str(options.sequence)},
            kind="serial-csv",
            serial_number=options.serial_number,
            unit=options.unit,
            nominal_sensitivity=nominal_sensitivity(options.unit),
            axes=options.axes,
        )
