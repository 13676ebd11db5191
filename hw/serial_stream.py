"""Driver `serial-csv`: a device that writes one sample a line on a serial port, `[seq,]x,y,z` or as `columns` says."""

from __future__ import annotations

import math
from typing import Any, Literal, Self

import serial
from pydantic import Field, model_validator

from hw.block import DeviceInfo
from hw.cutting import Cutter
from hw.line_columns import AXES, IGNORED, Column, columns_of
from hw.line_stream import LineStream
from hw.lines import MOST_COLUMNS
from hw.serial_sensor import BITS_A_BYTE, LONGEST_GAP_S, Filters, SerialOptions, SerialSensor
from hw.units import Unit, asked_of_certificate, nominal_sensitivity, tells_sensitivity

MILLIS_BLIND_HZ = 500.0  # from here on, a missing sample and the resolution change the time by as much


class SerialCsvOptions(SerialOptions):
    """Options of `serial-csv`: a line has the columns of `columns`, or else those of `axes` and `sequence`."""

    axes: Literal[1, 3] = Field(3, description="1: uniaxial device, 3: x,y,z")
    rate_hz: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="nominal rate of the samples")
    sequence: bool = Field(
        False, description="each line begins with a sample counter; without it lost lines are not noticed"
    )
    columns: tuple[Column, ...] = Field(
        (),
        max_length=MOST_COLUMNS,
        description="fields of a line in their order: seq (a sample counter) or millis or micros (time of the device), "
        "x y z or a, temperature (degC), - (not read); default: as axes and sequence say",
    )
    unit: Unit = Field("m/s2", description="of the indications")
    full_scale: float | None = Field(None, gt=0, description="indications of this size or more are saturated")
    serial_number: str = Field("", description="of the device, as on its label")
    filters: Filters = ()

    @model_validator(mode="before")
    @classmethod
    def _follow_columns(cls, stated: Any) -> Any:
        """What `columns` says of axes and sequence need not be stated again."""
        columns = stated.get("columns") if isinstance(stated, dict) else None
        if not isinstance(columns, (list, tuple)) or not columns:
            return stated
        return {"axes": 1 if "a" in columns else 3, "sequence": "seq" in columns} | stated

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if not self.columns:
            return self
        read = [name for name in self.columns if name != IGNORED]
        if twice := sorted({name for name in read if read.count(name) > 1}):
            raise ValueError(f"columns: {twice[0]} is there twice; write - for a column that is not read")
        if tuple(sorted(set(read) & {"x", "y", "z", "a"})) not in AXES.values():
            raise ValueError("columns: x, y and z are needed, or a alone for a uniaxial device")
        axes = 1 if "a" in read else 3
        if (self.axes, self.sequence) != (axes, "seq" in read):
            raise ValueError(
                f"columns have {axes} axes and {'a' if 'seq' in read else 'no'} seq, but axes = {self.axes} and "
                f"sequence = {str(self.sequence).lower()}: leave out axes and sequence"
            )
        return self

    @property
    def axis_count(self) -> int:
        """As stated."""
        return self.axes

    @property
    def line(self) -> tuple[Column, ...]:
        """The columns of a line."""
        return self.columns or columns_of(self.axes, self.sequence)

    @property
    def known_filters(self) -> tuple[str, ...]:
        """As the user states them."""
        return self.filters

    @property
    def advice(self) -> tuple[str, ...]:
        """What the time in a line cannot tell, and a port that is too slow for the shortest lines."""
        told = []
        if "millis" in self.columns and "seq" not in self.columns and self.rate_hz >= MILLIS_BLIND_HZ:
            told.append(
                f"millis does not tell one missing sample at rate_hz {self.rate_hz:g}; let the device send micros or a "
                "counter (seq)"
            )
        bits_hz = BITS_A_BYTE * 2 * len(self.line) * self.rate_hz
        if bits_hz > self.baud_rate:
            told.append(
                f"{self.rate_hz:g} lines/s of {len(self.line)} numbers are at least {bits_hz:g} bit/s, baud_rate is "
                f"{self.baud_rate}; correct one of them (a device that is USB itself may be faster than it)"
            )
        return tuple(told)

    @property
    def tells_sensitivity(self) -> bool:
        """Whether it indicates m/s2 or g: nothing else is known of such a device."""
        return tells_sensitivity(self.unit)

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)


class SerialCsv(SerialSensor):
    """Bad lines are counted and skipped; a jump in the sample counter, or in the time of the device, is a gap."""

    options_model = SerialCsvOptions

    def _build_stream(self, name: str) -> LineStream:
        options = self._options
        limit = options.full_scale or math.inf
        return LineStream(
            Cutter(name, options.rate_hz, -limit, limit),
            options.line,
            longest_gap=LONGEST_GAP_S * options.rate_hz,
        )

    def _set_up(self, port: serial.Serial) -> DeviceInfo:  # noqa: ARG002 - such a device has no settings
        options = self._options
        settings = {"sequence": str(options.sequence)}
        if options.columns:
            settings["columns"] = ",".join(options.columns)
        return self._info(
            "serial-csv",
            settings,
            kind="serial-csv",
            serial_number=options.serial_number,
            unit=options.unit,
            nominal_sensitivity=nominal_sensitivity(options.unit),
            axes=options.axes,
        )
