"""Driver `mqtt`: blocks of samples that a device publishes through an MQTT broker, as Sparkplug B or JSON."""

from __future__ import annotations

import contextlib
import select
import ssl
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from hw.block import BlockFlags, DeviceInfo
from hw.host import Host
from hw.message_sensor import OUTSIDE, MessageSensor, Piece
from hw.mqtt_payload import Block, Json, PayloadError, Sparkplug
from hw.sensor import ConfigurationError, DeviceLost, Options
from hw.units import Unit, asked_of_certificate, nominal_sensitivity, tells_sensitivity
from hw.vendor_library import vendor_library

MOST_BYTES = 1 << 20  # of a message: the broker is told to send none that is larger (MQTT 5, maximum packet size)
MOST_MESSAGES = 256  # taken at a time
LONGEST_S = 10.0  # of samples in one message
LONGEST_GAP_S = 30.0  # a longer jump of the counter means that it was set back
KEEP_ALIVE_S, ANSWER_S, POLL_S = 20, 5.0, 0.01
SPARKPLUG = "spBv1.0"
REFUSED = 128  # reason codes of MQTT from here on are refusals
UNREADABLE = "messages without the block of samples that is asked for"
LATEST_MS = 1e14  # the year 5138: larger stamps are no times


class MqttOptions(Options):
    """Options of `mqtt`."""

    host: Host = Field(description="name or address of the broker (MQTT 5)")
    port: int = Field(1883, ge=1, le=65535, description="its TCP port; 8883 is usual with TLS")
    topic: str = Field(
        min_length=1, max_length=1000,
        description="topic, as spBv1.0/bridge/+/gateway/imu; + takes births and data of Sparkplug",
    )  # fmt: skip
    payload: Literal["sparkplug-b", "json"] = Field("sparkplug-b", description="format of a message")
    metrics: tuple[str, ...] = Field(("x", "y", "z"), description="names of the arrays: one, or three for x, y, z")
    counter: str = Field(
        "", description="name of the number of a message's first sample; without it lost messages are not noticed"
    )
    stamp: Literal["arrival", "first", "last"] = Field(
        "arrival", description="what tells the time: the arrival, or the time stamp of the first or last sample"
    )
    rate_hz: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="nominal rate of the samples")
    unit: Unit = Field("m/s2", description="of the indications")
    full_scale: float | None = Field(None, gt=0, description="indications of this size or more are saturated")
    serial_number: str = Field("", description="of the device, as on its label")
    username: str | None = Field(None, description="for the broker")
    password_file: str | None = Field(None, description="file whose first line is the password")
    ca_file: str | None = Field(None, description="certificates (PEM) that the broker's must come from; turns on TLS")

    @field_validator("metrics")
    @classmethod
    def _check_axes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if len(value) not in (1, 3) or len(set(value)) != len(value) or not all(value):
            raise ValueError(f"1 or 3 different names are needed, not {', '.join(value)}")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.password_file is not None and self.username is None:
            raise ValueError("password_file: a password needs a username; add it")
        return self

    def check_installed(self) -> None:
        """Raises ConfigurationError, with what to install, where the MQTT library is not there."""
        _library()

    @property
    def axis_count(self) -> int:
        """One for each array of a message."""
        return len(self.metrics)

    @property
    def tells_sensitivity(self) -> bool:
        """Whether it indicates m/s2 or g: nothing else is known of such a device."""
        return tells_sensitivity(self.unit)

    @property
    def asked_of_certificate(self) -> str:
        """A reference that indicates g has not the sensitivity 1."""
        return asked_of_certificate(self.unit)


class Mqtt(MessageSensor):
    """Each message holds consecutive samples of all axes. Messages that hold none are counted and skipped."""

    options_model: ClassVar[type[Options]] = MqttOptions

    _client: Any = None

    def _where(self) -> str:
        return f"MQTT {self._options.host}:{self._options.port}/{self._options.topic}"

    def _connect(self) -> DeviceInfo:
        o = self._options
        self._decoder = (Sparkplug if o.payload == "sparkplug-b" else Json)(o.metrics, o.counter)
        self._came: deque[tuple[int, int, Any]] = deque()
        self._next: int | None = None
        self._before = BlockFlags.NONE
        self._follow_utc()
        self._subscribe()
        return DeviceInfo(
            driver="mqtt",
            kind="MQTT",
            serial_number=o.serial_number,
            unit=o.unit,
            axes=len(o.metrics),  # type: ignore[arg-type] # 1 or 3
            nominal_rate_hz=o.rate_hz,
            nominal_sensitivity=nominal_sensitivity(o.unit),
            settings={
                "port": f"{o.host}:{o.port}", "topic": o.topic, "metrics": ", ".join(o.metrics), "stamp": o.stamp,
            },
        )  # fmt: skip

    def _subscribe(self) -> None:
        """Connect, and wait until the broker has accepted the subscription."""
        library, o = _library(), self._options
        codes: list[Any] = []
        self._client = client = library.Client(library.CallbackAPIVersion.VERSION2, protocol=library.MQTTv5)
        client.on_connect = lambda c, u, flags, code, properties: codes.append(code)  # noqa: ARG005
        client.on_subscribe = lambda c, u, mid, granted, properties: codes.extend(granted)  # noqa: ARG005
        client.on_message = self._keep
        properties = _library("properties").Properties(_library("packettypes").PacketTypes.CONNECT)
        properties.MaximumPacketSize = MOST_BYTES
        try:
            if o.username is not None:
                client.username_pw_set(o.username, _password(o.password_file))
            if o.ca_file is not None:
                client.tls_set_context(ssl.create_default_context(cafile=o.ca_file))
            client.connect(o.host, o.port, KEEP_ALIVE_S, clean_start=True, properties=properties)
        except OSError as error:
            raise DeviceLost(f"{self._where()}: {error}") from error
        self._wait_for_answer(codes, "the connection")
        _, _ = client.subscribe(o.topic, options=_library("subscribeoptions").SubscribeOptions(retainHandling=2))
        self._wait_for_answer(codes, "the subscription")

    def _wait_for_answer(self, codes: list[Any], what: str) -> None:
        """Wait for the answer of the broker. Raises ConfigurationError where it refuses."""
        latest_ns = self._clock()[0] + round(ANSWER_S * 1e9)
        while not codes:
            if self._clock()[0] > latest_ns:
                raise DeviceLost(f"{self._where()}: the broker did not answer within {ANSWER_S:g} s")
            self._sleep(POLL_S)
            try:
                self._exchange()
            except DeviceLost:  # a broker that refuses the connection also closes it
                if not codes:
                    raise
        code = codes.pop()
        if code.value >= REFUSED:
            raise ConfigurationError(f"{self._where()}: the broker refuses {what}: {code}")

    def _stop(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(OSError, ValueError):
                client.disconnect()
            held = client.socket()
            if held is not None:
                held.close()

    def _keep(self, client: Any, userdata: Any, message: Any) -> None:  # noqa: ARG002 - the library's signature
        now_ns, utc_ns = self._clock()
        self._came.append((now_ns, utc_ns, message))

    def _exchange(self) -> None:
        """Read what has come, answer, and keep the connection alive; waits for nothing. Raises DeviceLost."""
        client = self._client
        try:
            for _ in range(MOST_MESSAGES):
                held = client.socket()
                if held is None:
                    raise DeviceLost(f"{self._where()}: the broker closed the connection")
                if not _waits(held):
                    break
                client.loop_read()
            if client.want_write():
                client.loop_write()
            client.loop_misc()
        except DeviceLost:
            raise
        except Exception as error:  # the library raises anything on bytes that are no MQTT
            raise DeviceLost(f"{self._where()}: the broker sent what is no MQTT: {error!r}") from error

    def _receive(self) -> Iterator[Piece]:
        if self._follow_utc() and self._options.stamp != "arrival":
            self._before = BlockFlags.RESTART
        self._exchange()
        while self._came:
            now_ns, utc_ns, message = self._came.popleft()
            try:
                block = self._decode(message)
                if block is not None:
                    yield self._piece(block, now_ns, utc_ns)
            except PayloadError as error:
                self._dropped["bytes", str(error)] += len(message.payload)
                self._before = BlockFlags.RESTART

    def _decode(self, message: Any) -> Block | None:
        """The block in a message; None if it announces a device instead. Raises PayloadError."""
        try:
            parts = message.topic.split("/")
        except UnicodeDecodeError:
            raise PayloadError(UNREADABLE) from None
        if message.retain:
            raise PayloadError("retained messages, whose time is not known")
        try:
            if isinstance(self._decoder, Sparkplug) and parts[0] == SPARKPLUG and parts[2:3] != ["DDATA"]:
                if parts[2:3] == ["DBIRTH"]:
                    self._decoder.learn(message.payload)
                return None
            return self._decoder(message.payload)
        except PayloadError:
            raise PayloadError(UNREADABLE) from None

    def _piece(self, block: Block, now_ns: int, utc_ns: int) -> Piece:
        """The samples with their time and with what lies before them. Raises PayloadError."""
        n, o = len(block.indications), self._options
        if n > LONGEST_S * o.rate_hz:
            raise PayloadError(f"messages with more than {LONGEST_S:g} s of samples")
        if o.stamp != "arrival":
            if block.stamp_ms is None or not 0.0 <= block.stamp_ms <= LATEST_MS:
                raise PayloadError("messages without a time stamp in ms since 1970")
            last_s = (n - 1) / o.rate_hz if o.stamp == "first" else 0.0
            utc_ns = round(block.stamp_ms * 1e3) * 1000 + round(last_s * 1e9)
            now_ns = utc_ns - self._utc_ns
        if not self._is_timely(now_ns):
            raise PayloadError(OUTSIDE)
        flags, missing = self._break_before(block.counter)
        self._next = None if block.counter is None else block.counter + n
        return Piece(block.indications, now_ns, utc_ns, flags, missing)

    def _break_before(self, counter: int | None) -> tuple[BlockFlags, int]:
        """What lies before the samples of a message whose first one has this number. Raises PayloadError."""
        flags, self._before = self._before, BlockFlags.NONE
        if self._options.counter and counter is None:
            raise PayloadError(UNREADABLE)
        if counter is None or self._next is None:
            return flags, 0
        missing = counter - self._next
        if 0 < missing <= LONGEST_GAP_S * self._options.rate_hz:
            return BlockFlags.GAP, missing
        # A bad message is no loss where the counter goes on without a step.
        return (BlockFlags.NONE if missing == 0 else BlockFlags.RESTART), 0


def _waits(held: Any) -> bool:
    """Whether bytes of the broker wait at this socket."""
    return (isinstance(held, ssl.SSLSocket) and held.pending() > 0) or bool(select.select([held], [], [], 0)[0])


def _password(path: str | None) -> str | None:
    """The first line of the file. Raises OSError."""
    return None if path is None else Path(path).read_text("utf-8").partition("\n")[0].strip()


def _library(module: str = "client") -> Any:
    return vendor_library(f"paho.mqtt.{module}", "mqtt", "mqtt", "a broker of MQTT 5")
