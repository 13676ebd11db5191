"""Driver `shake-udp`: a Raspberry Shake that sends its samples over UDP ("datacast"), one datagram for each channel.

The Shake sends to the address and port that its web page states; nothing is asked of it, and a datagram has no number.
What each channel measures is as in rsudp (rsudp/helpers.py): EH? and SH? are geophones (velocity), EN? accelerometers.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import socket
from typing import ClassVar

from pydantic import Field, field_validator

from hw import shake_datagram
from hw.block import DeviceInfo
from hw.sensor import ConfigurationError, DeviceLost, Options
from hw.stamped_sensor import StampedSensor

QUANTITIES = {"EH": "velocity", "SH": "velocity", "EN": "acceleration"}
UNITS = {"velocity": "m/s", "acceleration": "m/s2"}
SILENT_S, POLL_S = 5.0, 0.02  # a Shake sends four datagrams a second for each channel
BUFFER_BYTES = 1 << 18  # of the socket; what comes when it is full is lost, and a gap by the times
LONGEST_BYTES = 65536  # more than a datagram can have
MOST_DATAGRAMS = 2000  # in one poll; a sender that floods the port is read in the next poll
PROOF_STEPS = 8  # from datagram to datagram, of which one at least must have the stated rate
UNREADABLE = "bytes that are no datagram of a Raspberry Shake"
OTHERS = "bytes of another sender"
NOT_ASKED = "samples of a channel that was not asked for"


class ShakeUdpOptions(Options):
    """Options of `shake-udp`."""

    port: int = Field(8888, ge=1, le=65535, description="UDP port of this computer to which the Shake sends")
    listen: str = Field("0.0.0.0", description="address of this computer; 0.0.0.0 is all")
    source: str = Field("", description="address of the Shake; others are not used; empty: that of the first sender")
    channels: tuple[str, ...] = Field(description='one channel, or three for x, y, z: ["ENE", "ENN", "ENZ"]')
    rate_hz: float = Field(100.0, gt=0, le=10_000, description="rate of the samples; old Shakes have 50")
    full_scale: float | None = Field(None, gt=0, description="counts of this size or more are saturated")
    serial_number: str = Field("", description="of the instrument, as on its label")

    @field_validator("channels")
    @classmethod
    def _check_axes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(value) not in (1, 3) or len(set(value)) != len(value):
            raise ValueError(f"1 or 3 different channels are needed, not {', '.join(value)}")
        if not all(len(channel) == 3 and channel[:2] in QUANTITIES for channel in value):
            raise ValueError(f"each channel begins with {', '.join(QUANTITIES)}, as ENZ does, not {', '.join(value)}")
        if len({QUANTITIES[channel[:2]] for channel in value}) > 1:
            raise ValueError(f"{', '.join(value)} are of a geophone and of an accelerometer; give those of one")
        return value

    @field_validator("listen", "source")
    @classmethod
    def _address(cls, value: str) -> str:
        return str(ipaddress.ip_address(value)) if value else value

    @property
    def axis_count(self) -> int:
        """One for each channel."""
        return len(self.channels)

    @property
    def quantity(self) -> str:
        """By the names of the channels."""
        return QUANTITIES[self.channels[0][:2]]

    @property
    def tells_sensitivity(self) -> bool:
        """It tells counts; the metadata of the station state the sensitivity."""
        return False

    @property
    def asked_of_certificate(self) -> str:
        """It tells counts."""
        return (
            f"it indicates counts; state counts per {UNITS[self.quantity]}, from the certificate or the metadata of "
            "the station"
        )


def receiver(listen: str, port: int, where: str) -> socket.socket:
    """A socket, which does not block, with the datagrams that come to this UDP port; `where` begins each message.

    Raises ConfigurationError where the port cannot be had, DeviceLost where the address is not one of this computer.
    """
    found = socket.socket(socket.AF_INET6 if ":" in listen else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        found.setblocking(False)
        found.bind((listen, port))
    except OSError as error:
        found.close()
        if error.errno == errno.EADDRINUSE:
            raise ConfigurationError(
                f"{where}: another program receives at this port; end it, or have the Shake send to a port of its own "
                "for fieldcal"
            ) from error
        kind = ConfigurationError if error.errno == errno.EACCES else DeviceLost
        raise kind(f"{where}: {error.strerror}") from error
    return found


class ShakeUdp(StampedSensor):
    """Counts of one channel or three, at the times that the Shake stamped on its datagrams."""

    options_model: ClassVar[type[Options]] = ShakeUdpOptions
    repeated: ClassVar[str] = "samples of datagrams that came twice, or after later ones"

    _socket: socket.socket | None = None

    def _where(self) -> str:
        o = self._options
        return f"Raspberry Shake at {o.listen}:{o.port}/{','.join(o.channels)}"

    def _connect(self) -> DeviceInfo:
        o = self._options
        self._socket = receiver(o.listen, o.port, self._where())
        self._axis = {channel: k for k, channel in enumerate(o.channels)}
        self._source = o.source
        self._seen: set[str] = set()
        self._ends_ns: dict[str, int] = {}
        self._in_step, self._out_of_step = False, 0
        self._heard_ns = self._clock()[0]
        self._align()
        while self._seen.isdisjoint(self._axis):  # what comes meanwhile is kept
            self._sleep(POLL_S)
            self._take_messages()
        return DeviceInfo(
            driver="shake-udp",
            kind="Raspberry Shake",
            serial_number=o.serial_number,
            unit="count",
            axes=len(o.channels),  # type: ignore[arg-type] # 1 or 3
            nominal_rate_hz=o.rate_hz,
            settings={"port": f"{o.listen}:{o.port}", "channels": ", ".join(o.channels), "quantity": o.quantity},
        )

    def _stop(self) -> None:
        held, self._socket = self._socket, None
        if held is not None:
            with contextlib.suppress(OSError):
                held.close()

    def _take_messages(self) -> None:
        assert self._socket is not None
        for _ in range(MOST_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(LONGEST_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                raise DeviceLost(f"{self._where()}: {error.strerror}") from error
            self._take(data, sender[0])
        if self._clock()[0] - self._heard_ns > SILENT_S * 1e9:
            others = ", ".join(sorted(self._seen - self._axis.keys())) or "none"
            raise DeviceLost(
                f"{self._where()}: no datagram with these channels came for {SILENT_S:g} s; other channels that came: "
                f"{others}; state this computer and this port on the Shake's page, and open the port in the firewall"
            )

    def _take(self, data: bytes, sender: str) -> None:
        """Take one datagram. Raises DeviceLost where its rate is not the configured one."""
        if sender != (self._source or sender):
            self._dropped["bytes", OTHERS] += len(data)
            return
        try:
            datagram = shake_datagram.decode(data)
        except shake_datagram.DatagramError:
            self._dropped["bytes", UNREADABLE] += len(data)
            return
        axis = self._axis.get(datagram.channel)
        self._seen.add(datagram.channel)
        if axis is None:
            self._dropped["samples", NOT_ASKED] += len(datagram.samples)
            return
        self._source = sender
        self._heard_ns = self._clock()[0]
        self._check_rate(datagram)
        self._add(axis, datagram.start_ns, datagram.samples)

    def _check_rate(self, datagram: shake_datagram.Datagram) -> None:
        """Raises DeviceLost where no datagram of several begins where the one before ends."""
        channel, rate_hz, n = datagram.channel, self._options.rate_hz, len(datagram.samples)
        end_ns = self._ends_ns.get(channel)
        self._ends_ns[channel] = datagram.start_ns + round(n * 1e9 / rate_hz)
        if self._in_step or end_ns is None:
            return
        self._in_step = abs(datagram.start_ns - end_ns) * rate_hz < 0.5e9
        self._out_of_step += not self._in_step
        if self._out_of_step >= PROOF_STEPS:
            raise DeviceLost(
                f"{self._where()}: {channel} sends {n} samples at a time, and no datagram begins where the one before "
                f"ends at rate_hz {rate_hz:g}; state the rate of the Shake"
            )
