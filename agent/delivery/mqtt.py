"""Publishes a gateway's newest results to an MQTT broker. It never delays the rest of the agent.

MQTT 5 by paho-mqtt, which is loaded only where the configuration turns this on. One thread has the connection; the
others only put values into a table. Each connection has a client of its own, so that nothing old is sent again.
Sources: OASIS MQTT 5.0, 3.1.2.5 (will), 3.2.2.3 (limits of the broker), 3.3.1.3 (retained values), 3.14.2 (reasons).
"""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec

from agent.config import Mqtt
from agent.config.broker import read_password, tls_context
from agent.delivery.history import History, StoredResult, StoreError
from agent.delivery.home_assistant import entities_of_gateway, entities_of_sensor
from hw.vendor_library import vendor_library

POLL_S = 0.2  # s after which a new value is noticed
ANSWER_S = 5.0  # s in which a broker must answer
KEEP_ALIVE_S = 20  # after one and a half of it without a sign of this gateway, the broker publishes its will
FLYING_MAX = 16  # values that the broker has not acknowledged yet
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # s between two attempts; doubled unless the connection held for longer
MOST_DRIFTS = 120  # ten changes of verdict of each of the twelve parameters
CLOSE_S = 1.2  # s to wait at the end
OVERHEAD = 16  # bytes of a message besides topic and payload, at most
REFUSED = 128  # reason codes of MQTT from here on are refusals
WITH_WILL = 4  # reason code of a disconnection after which the broker publishes the will
OWN_ID = "state an mqtt.client_id of its own for each gateway"  # mosquitto 2.0 tells no reason when it is taken over
REMEDIES = {
    134: "; correct mqtt.username and mqtt.password_file",
    135: "; correct mqtt.username and mqtt.password_file, or the rights of this user at the broker",
    142: f"; another program has the same client_id: {OWN_ID}",
    154: "; it keeps no retained values, which are needed: turn them on at the broker",
    155: "; it does not take QoS 1, which is needed: turn it on at the broker",
}

_log = logging.getLogger(__name__)


class MqttState(msgspec.Struct, frozen=True, kw_only=True):
    """The publication to an MQTT broker. `waiting`: topics whose newest value the broker has not taken yet.

    Counts of this run: `superseded`: values that a newer one of their topic replaced before they were sent; `refused`:
    values that the broker refused, or that were too large for it. `fault`: "" where there is none.
    """

    connected: bool
    waiting: int
    superseded: int
    refused: int
    fault: str


class BrokerLostError(Exception):
    """There is no connection to the broker. The message says why and what to do."""


class MqttPublisher:
    """Keeps the newest value of each topic, and has the broker retain it (QoS 1).

    Topics are `<topic>/<site>/<gateway>/<sensor>/<what>`, for a drift verdict and a clock followed by their parameter
    or device; `.../<gateway>/status`; and `.../<gateway>/alive` with `online` or `offline`, which is also the will.
    Values are those of Zenoh. The table is bounded by the numbers of sensors, kinds, parameters and devices. After an
    outage each topic gets its newest value, also a topic without a new one: a broker may have forgotten it.

    `history`: opens the store, in which the newest results before this run are. `poll_s`, `pause_s`: as POLL_S and
    FIRST_PAUSE_S. Raises ConfigurationError without the library, KeyFileError for a file that cannot be used. The
    methods raise nothing and return at once, `close` after CLOSE_S.
    """

    def __init__(
        self,
        site: str,
        gateway: str,
        settings: Mqtt,
        history: Callable[[], History],
        *,
        poll_s: float = POLL_S,
        pause_s: float = FIRST_PAUSE_S,
    ) -> None:
        self._library = vendor_library("paho.mqtt.client", "of the section mqtt", "mqtt", "a broker of MQTT 5")
        self._place, self._settings, self._history = (site, gateway), settings, history
        self._topic = f"{settings.topic}/{site}/{gateway}"
        self._client_id = settings.client_id or f"fieldcal-{site}-{gateway}"
        self._password = read_password(settings.password_file) if settings.password_file else None
        self._tls = tls_context(settings.tls) if settings.tls else None
        self._poll_s, self._pause_s = poll_s, pause_s
        self._mutex = threading.Lock()
        self._newest: dict[str, bytes] = {}
        self._waiting: dict[str, None] = {}  # topics, in the order in which they will be sent
        self._flying: dict[int, str] = {}  # topics by the number of the message
        self._most_bytes, self._most_flying = 0, FLYING_MAX
        self._answer: Any = None  # reason code of the broker's answer to a connection
        self._ended: Any = None  # reason code with which the broker ended the connection
        self._connected = False
        self._superseded = self._refused = 0
        self._faults: dict[str, str] = {}  # by topic; "": of the connection
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)
        if settings.home_assistant:
            self._put_values(entities_of_gateway(settings.home_assistant, self._topic, site, gateway))

    def start(self) -> None:
        """Start publishing in a thread of its own."""
        self._thread.start()

    def publish(self, record: StoredResult) -> None:
        """Publish a result, in place of an earlier one of its topic."""
        self._put_values(self._values(record))

    def tell_status(self, status: bytes) -> None:
        """Publish the gateway's status (JSON)."""
        self._put_values({f"{self._topic}/status": status})

    def state(self) -> MqttState:
        """The present state, for the gateway's status."""
        with self._mutex:
            waiting = len(self._waiting) + len(self._flying)
        return MqttState(
            connected=self._connected, waiting=waiting, superseded=self._superseded, refused=self._refused,
            fault=next(iter(self._faults.values()), ""),
        )  # fmt: skip

    def attempt(self, client_id: str) -> str:
        """Connect once under this client_id, and leave: why the broker does not take it, "" where it does.

        Nothing is published, and a connection of the agent under its own client_id stays.
        """
        self._client_id = client_id
        try:
            client = self._client(will=False)
            with contextlib.closing(client.socket()):
                self._await_answer(client)
                client.disconnect()
        except BrokerLostError as error:
            return str(error)
        except Exception as error:  # the library raises anything on bytes that are no MQTT
            return self._no_broker(error)
        return ""

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Publish what waits if a broker is connected, say that the gateway is off, and close."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _values(self, record: StoredResult) -> dict[str, bytes]:
        """What a result publishes, by topic. An empty value lets the broker forget the one that it retains."""
        end = {"drift": "parameter", "clock": "device"}.get(record.what)
        parts = [self._topic, record.sensor, record.what, str(record.fields.get(end, "")) if end else ""]
        values = {"/".join(part for part in parts if part): record.payload}
        if record.is_withdrawal:
            values[f"{self._topic}/{record.sensor}/calibration"] = b""
        if record.what == "calibration" and self._settings.home_assistant:
            values |= entities_of_sensor(self._settings.home_assistant, self._topic, *self._place, record)
        return values

    def _put_values(self, values: dict[str, bytes], *, only_new: bool = False) -> None:
        """Let these values be sent; with `only_new` those of topics that have none yet."""
        with self._mutex:
            for topic, value in values.items():
                if (only_new and topic in self._newest) or self._newest.get(topic) == value:
                    continue
                self._superseded += topic in self._waiting
                self._newest[topic] = value
                self._waiting[topic] = None

    def _run(self) -> None:
        self._remember()
        pause_s = self._pause_s
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                self._serve()
            except BrokerLostError as error:
                self._fail("", str(error))
            except Exception as error:  # the library raises anything on bytes that are no MQTT
                self._fail("", self._no_broker(error))
            self._connected = False
            held = time.monotonic() - begun > pause_s + ANSWER_S
            pause_s = self._pause_s if held else min(2 * pause_s, LONGEST_PAUSE_S)
            self._stop.wait(pause_s)

    def _remember(self) -> None:
        """Take the newest results of earlier runs, which a broker may not have."""
        values: dict[str, bytes] = {}
        try:
            with self._history() as history:
                records = history.latest()
                sensors = {record.sensor for record in records if record.what == "drift"}
                for sensor in sensors:
                    records = [*reversed(history.newest(sensor, "drift", limit=MOST_DRIFTS)), *records]
                for record in records:
                    values |= self._values(record)
        except (StoreError, sqlite3.Error) as error:
            _log.warning("MQTT: results of earlier runs are not published: %s", error)
        self._put_values(values, only_new=True)

    @property
    def _address(self) -> str:
        return f"{self._settings.host}:{self._settings.port}"

    def _no_broker(self, error: Exception) -> str:
        return f"{self._address}: what answers there is no broker of MQTT 5: {error!r}"

    def _serve(self) -> None:
        """Connect, and publish until the connection ends or `close` is called. Raises BrokerLostError."""
        client = self._client()
        try:
            self._begin(client)
            stopping = False
            while not stopping:
                stopping = self._stop.is_set()  # read first: the last round then sends all that was handed over
                self._send(client)
                self._turn(client)
            self._finish(client)
        finally:
            with contextlib.suppress(OSError, ValueError):
                if (held := client.socket()) is not None:
                    held.close()

    def _client(self, *, will: bool = True) -> Any:
        """A client that is being connected, with a will or without one. Raises BrokerLostError."""
        library, settings = self._library, self._settings
        client = library.Client(
            library.CallbackAPIVersion.VERSION2, self._client_id, protocol=library.MQTTv5, reconnect_on_failure=False
        )
        client.max_inflight_messages_set(FLYING_MAX)
        client.connect_timeout = ANSWER_S
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish
        if will:
            client.will_set(f"{self._topic}/alive", "offline", 1, True)
        if settings.username is not None:
            client.username_pw_set(settings.username, self._password)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        self._answer = self._ended = None
        try:
            client.connect(settings.host, settings.port, KEEP_ALIVE_S, clean_start=True)
        except (OSError, ValueError) as error:  # ValueError: a name that cannot be looked up
            raise BrokerLostError(f"{self._address}: {_fault_text(error)}") from None
        return client

    def _begin(self, client: Any) -> None:
        """Wait for the broker's answer, then let all topics be sent. Raises BrokerLostError."""
        self._await_answer(client)
        with self._mutex:
            self._flying.clear()
            self._waiting = dict.fromkeys(self._newest)
        self._connected, self._faults = True, {}
        client.publish(f"{self._topic}/alive", "online", 1, True)

    def _await_answer(self, client: Any) -> None:
        """Until the broker has taken the connection. Raises BrokerLostError."""
        latest = time.monotonic() + ANSWER_S
        while self._answer is None:
            if time.monotonic() > latest:
                raise BrokerLostError(f"{self._address}: the broker did not answer within {ANSWER_S:g} s")
            self._turn(client)

    def _turn(self, client: Any) -> None:
        """Read and write what can be, for `poll_s` at most. Raises BrokerLostError."""
        failed = client.loop(self._poll_s)
        if self._answer is not None and self._answer.value >= REFUSED:
            code = self._answer
            raise BrokerLostError(
                f"{self._address}: the broker refuses the connection: {code}{REMEDIES.get(code.value, '')}"
            )
        if failed or self._ended is not None:
            unknown = (
                f"no reason told; if this repeats, another program has the client_id {self._client_id!r}: {OWN_ID}"
            )
            why = unknown if self._ended is None else _reason(self._ended)
            raise BrokerLostError(f"{self._address}: the connection to the broker ended: {why}")

    def _send(self, client: Any) -> None:
        """Send waiting values as long as the broker acknowledges them."""
        while len(self._flying) < self._most_flying:
            with self._mutex:
                topic = next(iter(self._waiting), None)
                if topic is None:
                    return
                del self._waiting[topic]
                value = self._newest[topic]
            size = len(topic.encode()) + len(value) + OVERHEAD
            if self._most_bytes and size > self._most_bytes:
                self._refuse(topic, f"{size} bytes, but the broker takes {self._most_bytes} at most")
                continue
            self._flying[client.publish(topic, value, 1, True).mid] = topic

    def _finish(self, client: Any) -> None:
        """Wait until what was sent is acknowledged, and leave. Raises BrokerLostError."""
        latest = time.monotonic() + CLOSE_S
        while (self._flying or self._waiting) and time.monotonic() < latest:
            self._send(client)
            self._turn(client)
        codes, kinds = (vendor_library(f"paho.mqtt.{name}", "", "mqtt", "") for name in ("reasoncodes", "packettypes"))
        client.disconnect(codes.ReasonCode(kinds.PacketTypes.DISCONNECT, identifier=WITH_WILL))

    def _on_connect(self, client: Any, data: Any, flags: Any, code: Any, properties: Any) -> None:  # noqa: ARG002
        self._most_bytes = getattr(properties, "MaximumPacketSize", 0)
        self._most_flying = min(FLYING_MAX, getattr(properties, "ReceiveMaximum", FLYING_MAX))
        self._answer = code

    def _on_disconnect(self, client: Any, data: Any, flags: Any, code: Any, properties: Any) -> None:  # noqa: ARG002
        if flags.is_disconnect_packet_from_server:
            self._ended = code

    def _on_publish(self, client: Any, data: Any, number: int, code: Any, properties: Any) -> None:  # noqa: ARG002
        with self._mutex:
            topic = self._flying.pop(number, f"{self._topic}/alive")
        if code.value >= REFUSED:
            self._refuse(topic, f"the broker refuses it: {_reason(code)}")
        elif topic in self._faults:
            self._faults = {of: fault for of, fault in self._faults.items() if of != topic}

    def _refuse(self, topic: str, fault: str) -> None:
        self._refused += 1
        self._fail(topic, f"{topic}: {fault}")

    def _fail(self, topic: str, fault: str) -> None:
        """Keep a fault for the status, and log it unless it was there before."""
        if fault != self._faults.get(topic):
            _log.warning("MQTT: %s", fault)
            self._faults = self._faults | {topic: fault}  # replaced, since other threads read it


def _reason(code: Any) -> str:
    """A reason code of MQTT in words, and what to do."""
    return f"{code}{REMEDIES.get(code.value, '')}"


def _fault_text(error: OSError | ValueError) -> str:
    """Why there is no connection, in words."""
    import ssl

    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"the broker's certificate is not trusted: {error.verify_message}; mqtt.tls.ca must hold the authority "
            f"that signed it, and mqtt.host must be the name in it"
        )
    return f"the broker cannot be reached: {getattr(error, 'strerror', None) or error}; correct mqtt.host and mqtt.port"
