"""Driver `seedlink`: a seismometer or accelerometer on a SeedLink server, such as a Raspberry Shake."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, field_validator

from hw import miniseed
from hw.block import DeviceInfo
from hw.host import Host
from hw.seedlink_link import SeedLinkConnection
from hw.sensor import DeviceLost, Options
from hw.stamped_sensor import StampedSensor

RATE_TOLERANCE = 0.01  # relative; records with another rate are another channel
UNREADABLE = "bytes that are no record of miniSEED 2"


class SeedlinkOptions(Options):
    """Options of `seedlink`."""

    host: Host = Field(description="name or address of the SeedLink server")
    port: int = Field(18000, ge=1, le=65535, description="its TCP port")
    network: str = Field("AM", pattern=r"^[A-Z0-9]{1,2}$", description="code of the network; AM is Raspberry Shake")
    station: str = Field(pattern=r"^[A-Z0-9]{1,5}$", description="code of the station, as R1234")
    location: str = Field("00", pattern=r"^[A-Z0-9]{0,2}$", description="code of the location; may be empty")
    channels: tuple[str, ...] = Field(description='one channel, or three for x, y, z: ["ENE", "ENN", "ENZ"]')
    rate_hz: float = Field(100.0, gt=0, le=10_000, description="nominal rate of the samples")
    full_scale: float | None = Field(None, gt=0, description="counts of this size or more are saturated")
    serial_number: str = Field("", description="of the instrument, as on its label")

    @field_validator("channels")
    @classmethod
    def _check_axes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(value) not in (1, 3) or len(set(value)) != len(value):
            raise ValueError(f"1 or 3 different channels are needed, not {', '.join(value)}")
        if not all(len(channel) == 3 and channel.isascii() and channel.isalnum() for channel in value):
            raise ValueError(f"each channel has three letters or digits, as in ENZ, not {', '.join(value)}")
        return value

    @property
    def axis_count(self) -> int:
        """One for each channel."""
        return len(self.channels)

    @property
    def tells_sensitivity(self) -> bool:
        """It tells counts; the metadata of the station state the sensitivity."""
        return False

    @property
    def asked_of_certificate(self) -> str:
        """It tells counts."""
        return (
            "it indicates counts; state counts per m/s2 (or per m/s, with quantity = velocity), "
            "from the certificate or the metadata of the station"
        )


class Seedlink(StampedSensor):
    """Counts of one channel or three, at the times that the station stamped on its records."""

    options_model: ClassVar[type[Options]] = SeedlinkOptions

    _link: SeedLinkConnection | None = None

    def _where(self) -> str:
        o = self._options
        return f"SeedLink {o.host}:{o.port}/{o.network}.{o.station}.{o.location}.{','.join(o.channels)}"

    def _connect(self) -> DeviceInfo:
        o = self._options
        self._axis = {f"{o.network}.{o.station}.{o.location}.{channel}": k for k, channel in enumerate(o.channels)}
        self._link = SeedLinkConnection(self._where(), self._clock, self._sleep)
        selectors = [f"{o.location}{channel}.D" for channel in o.channels]
        self._link.connect(o.host, o.port, o.station, o.network, selectors)
        self._align()
        return DeviceInfo(
            driver="seedlink",
            kind="SeedLink",
            serial_number=o.serial_number,
            unit="count",
            axes=len(o.channels),  # type: ignore[arg-type] # 1 or 3
            nominal_rate_hz=o.rate_hz,
            settings={"port": f"{o.host}:{o.port}", "channels": ", ".join(self._axis)},
        )

    def _stop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _take_messages(self) -> None:
        assert self._link is not None
        for data in self._link.records():
            self._take(data)

    def _take(self, data: bytes) -> None:
        """Take one record. Raises DeviceLost where its rate is not the configured one."""
        try:
            record = miniseed.decode(data)
        except miniseed.RecordError:
            self._dropped["bytes", UNREADABLE] += len(data)
            return
        axis = self._axis.get(record.channel)
        if axis is None:
            self._dropped["samples", "samples of a channel that was not asked for"] += len(record.samples)
            return
        rate_hz = self._options.rate_hz
        if abs(record.rate_hz - rate_hz) > RATE_TOLERANCE * rate_hz:
            raise DeviceLost(f"{self._where()}: {record.channel} has {record.rate_hz:g} Hz, not rate_hz {rate_hz:g}")
        self._add(axis, record.start_ns, record.samples)
