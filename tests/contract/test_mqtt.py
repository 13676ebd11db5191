"""The driver contract on `mqtt`: the real paho-mqtt on a twin of a broker, and Debian's mosquitto where it is."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from hw.block import BlockFlags, Drop, SampleBlock
from hw.conformance.network import NetworkRig
from hw.conformance.sensor import EPOCH_NS, SensorContract
from hw.message_sensor import OUTSIDE
from hw.mqtt import UNREADABLE, Mqtt, MqttOptions
from hw.mqtt_payload import PayloadError, Sparkplug
from hw.sensor import ConfigurationError, DeviceLost
from hw.sparkplug_pb2 import Payload
from hw.virtual.mqtt_twin import CONNECT, SUBSCRIBE, MqttTwin

paho = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)")

FULL = 1e9
TOPIC = "spBv1.0/bridge/DDATA/gateway/imu"
INT8, INT16, DOUBLES = 22, 23, 31


def sparkplug(values: NDArray[np.float64], counter: int, stamp_ms: int = 0, aliases: bool = False) -> bytes:
    payload = Payload(timestamp=stamp_ms)
    for k, (name, column) in enumerate(zip("xyz", values.T, strict=True)):
        metric = payload.metrics.add(datatype=DOUBLES, bytes_value=column.astype("<f8").tobytes())
        if aliases:
            metric.alias = k + 7
            metric.ClearField("datatype")
        else:
            metric.name = name
    payload.metrics.add(name="n", datatype=8, long_value=counter)
    return payload.SerializeToString()


class MqttRig(NetworkRig):
    known: dict[str, object] = {"topic": TOPIC, "counter": "n"}  # noqa: RUF012

    def __init__(self) -> None:
        self.saturated = range(0)
        self.server: MqttTwin = MqttTwin(TOPIC, self.payload, lambda: self.due(self.t_s))
        self.sensor = self.build()

    def build(self, **changes: object) -> Mqtt:
        known = {"host": "127.0.0.1", "port": self.server.port, "rate_hz": self.rate_hz, "full_scale": FULL}
        options = MqttOptions.model_validate(known | self.known | changes)
        return Mqtt("sensor", options, clock=self.clock, sleep=lambda s: self.sleep(s))

    def build_elsewhere(self) -> Mqtt:
        with socket.create_server(("127.0.0.1", 0)) as free:
            return self.build(port=free.getsockname()[1])

    def socket(self) -> socket.socket | None:
        client = getattr(getattr(self, "sensor", None), "_client", None)
        held = None if client is None else client.socket()
        return held if isinstance(held, socket.socket) else None

    def payload(self, first: int, n: int) -> bytes:
        return sparkplug(self.values(first, n), first, self.stamp_ms(first))

    def stamp_ms(self, number: int) -> int:
        return EPOCH_NS // 10**6 + round(number * 1e3 / self.rate_hz)

    def values(self, first: int, n: int) -> NDArray[np.float64]:
        k = np.arange(first, first + n, dtype=float)
        return np.column_stack([k, np.where(np.isin(k, self.saturated), -FULL, -k), 0.5 * k])

    def number(self, indications: NDArray[np.generic]) -> NDArray[np.int64]:
        x, y, z = indications.astype(float).T
        assert (z == 0.5 * x).all()
        assert ((y == -x) | ((y == -FULL) & np.isin(x, self.saturated))).all()
        return x.astype(np.int64)

    def saturate(self, first: int, last: int) -> None:
        self.saturated = range(first, last + 1)

    def lose(self) -> None:
        self.server.next += 3


class StampedRig(MqttRig):
    known = MqttRig.known | {"stamp": "first"}


class TestMqtt(SensorContract):
    @pytest.fixture
    def rig(self) -> Iterator[MqttRig]:
        rig = MqttRig()
        yield rig
        rig.close()

    def test_arrivals_are_late_by_less_than_a_sample(self, rig: MqttRig) -> None:  # type: ignore[override]
        """Replaced, because a message comes when it is full: its last sample must exist, and is at most a poll old."""
        rig.open()
        for block in rig.blocks(2.0):
            last_s = rig.number(block.indications)[block.burst_count - 1] / rig.rate_hz
            late_s = block.burst_t_monotonic_ns * 1e-9 - last_s
            assert (late_s >= 0).all()
            assert (late_s <= 0.0301).all()

    def test_polls_do_not_beat_with_the_sample_clock(self, rig: MqttRig) -> None:  # type: ignore[override]
        """Replaced, because only every 100th sample comes by itself: some messages are read at once in each second."""
        rig.open()
        blocks = list(rig.blocks(1.0))
        last_s = np.concatenate([rig.number(b.indications)[b.burst_count - 1] for b in blocks]) / rig.rate_hz
        late_s = np.concatenate([b.burst_t_monotonic_ns for b in blocks]) * 1e-9 - last_s
        share, _ = np.histogram(late_s, bins=4, range=(0.0, 0.02))
        assert share.min() >= 0.1 * len(late_s)

    def test_what_the_broker_refuses(self, rig: MqttRig) -> None:
        rig.server.refuses = {SUBSCRIBE}
        with pytest.raises(ConfigurationError, match="refuses the subscription: Not authorized"):
            rig.open()
        rig.server.refuses = {CONNECT}
        with pytest.raises((ConfigurationError, DeviceLost), match="refuses the connection: Not authorized"):
            rig.open()

    def test_hostile_messages(self, rig: MqttRig) -> None:
        rig.open()
        *_, before = rig.blocks(0.6)
        good = sparkplug(rig.values(0, 4), 0)
        short = Payload.FromString(good)
        short.metrics[1].bytes_value = short.metrics[1].bytes_value[:8]
        many = Payload()
        for name in "xyz":
            many.metrics.add(name=name, datatype=INT8, bytes_value=bytes(10_001))
        nan = sparkplug(np.full((4, 3), np.nan), 1)
        hostile = [b"\xff" * 50, b"", good[:-30], nan, short.SerializeToString(), many.SerializeToString()]
        for payload in hostile:
            rig.server.publish(payload)
        rig.server.publish(good, retain=True)
        rig.server.publish(b"\x08\x01", topic="spBv1.0/bridge/DDEATH/gateway/imu")
        block = next(rig.blocks(0.1))
        assert block.flags == BlockFlags.NONE, "the counter tells that no sample is missing"
        assert block.first_index == before.first_index + before.n
        drops = {drop.reason: drop for drop in rig.sensor.take_drops()}
        assert drops[UNREADABLE] == Drop(sum(len(payload) for payload in hostile[:-1]), "bytes", UNREADABLE)
        assert {reason.partition(" ")[0] for reason in drops} == {"messages", "retained"}
        rig.server.inject(b"\x31\xff\xff\xff\xff\xff")
        with pytest.raises(DeviceLost, match="MQTT 127"):
            list(rig.blocks(2.0))

    def test_without_a_counter_a_bad_message_restarts(self, rig: MqttRig) -> None:
        rig.sensor = rig.build(counter="")
        rig.open()
        list(rig.blocks(0.6))
        rig.server.publish(b"\xff")
        assert next(rig.blocks(0.1)).flags == BlockFlags.RESTART

    def test_aliases_are_learned_from_a_birth(self, rig: MqttRig) -> None:
        rig.sensor = rig.build(topic="spBv1.0/bridge/+/gateway/imu")
        rig.server._payload = lambda first, n: sparkplug(rig.values(first, n), first, aliases=True)
        rig.open()
        assert rig.sensor.read_block() is None
        assert {drop.reason for drop in rig.sensor.take_drops()} == {UNREADABLE}
        birth = Payload()
        for k, name in enumerate("xyz"):
            birth.metrics.add(name=name, alias=k + 7, datatype=DOUBLES)
        rig.server.publish(birth.SerializeToString(), topic="spBv1.0/bridge/DBIRTH/gateway/imu")
        assert next(rig.blocks(0.1)).n > 0

    def test_json(self, rig: MqttRig) -> None:
        rig.server._payload = lambda first, n: json.dumps(
            dict(zip("xyz", rig.values(first, n).T.tolist(), strict=True)) | {"n": first}
        ).encode()
        rig.sensor = rig.build(payload="json")
        rig.open()
        *_, before = rig.blocks(0.6)
        for bad in (
            b"[" * 100_000,
            b'{"x": "a"}',
            b'{"x": [1e999], "y": [1], "z": [1]}',
            b"\xff",
            b"{}",
            b'{"x": [1]}',
        ):
            rig.server.publish(bad)
        after = next(rig.blocks(0.1))
        assert after.first_index == before.first_index + before.n
        assert {drop.reason for drop in rig.sensor.take_drops()} == {UNREADABLE}


def test_stamps_tell_the_time() -> None:
    rig = StampedRig()
    try:
        rig.open()
        for block in rig.blocks(2.0):
            last = rig.number(block.indications)[block.burst_count - 1]
            assert block.burst_t_monotonic_ns.tolist() == (last * 10**6).tolist()
        for stamp_ms in (0, 2**63, rig.stamp_ms(rig.server.next) + 5000):
            rig.server.publish(sparkplug(rig.values(rig.server.next, 20), rig.server.next, stamp_ms))
        assert next(rig.blocks(0.5)).flags == BlockFlags.NONE
        reasons = {drop.reason for drop in rig.sensor.take_drops()}
        assert reasons == {OUTSIDE, "messages without a time stamp in ms since 1970"}
    finally:
        rig.close()


def test_integers_of_sparkplug() -> None:
    payload = Payload()
    for name, kind, code in (("x", "<i2", INT16), ("y", "i1", INT8), ("z", "<u8", 29)):
        values = np.array([1, 2, 100], kind)
        payload.metrics.add(name=name, datatype=code, bytes_value=values.tobytes())
    block = Sparkplug("xyz", "")(payload.SerializeToString())
    assert block.indications.tolist() == [[1, 1, 1], [2, 2, 2], [100, 100, 100]]
    payload.metrics[0].bytes_value += b"\0"
    with pytest.raises(PayloadError, match="no array of numbers"):
        Sparkplug("xyz", "")(payload.SerializeToString())


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    options = MqttOptions.model_validate({"host": "h", "topic": "t", "rate_hz": 100})
    with pytest.raises(ConfigurationError, match=r"fieldcal extras --install mqtt"):
        options.check_installed()


@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="mosquitto is not installed (apt-get install mosquitto)")
def test_a_real_broker_with_a_password_comes_and_goes(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    passwords, ours = tmp_path / "passwords", tmp_path / "password"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "imu", "right"], check=True)
    passwords.chmod(0o644)
    config = tmp_path / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous false\npassword_file {passwords}\nuser root\n")
    options = {"host": "127.0.0.1", "port": port, "topic": TOPIC, "rate_hz": 1000, "counter": "n", "username": "imu"}
    sensor = Mqtt("sensor", MqttOptions.model_validate(options | {"password_file": str(ours)}))
    publisher = paho.Client(paho.CallbackAPIVersion.VERSION2)
    publisher.username_pw_set("imu", "right")

    def started() -> subprocess.Popen[bytes]:
        process = subprocess.Popen(["mosquitto", "-c", config], stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                publisher.connect("127.0.0.1", port)
                break
            except OSError:
                time.sleep(0.05)
        while not publisher.is_connected() and time.monotonic() < deadline:
            publisher.loop(0.01)
        return process

    broker = started()
    try:
        ours.write_text("wrong\n")
        with pytest.raises((ConfigurationError, DeviceLost), match="refuses the connection: Not authorized"):
            sensor.open()
        ours.write_text("right\n")
        for begin in (0, 1000):
            assert sensor.open().settings["topic"] == TOPIC
            for first in range(begin, begin + 600, 100):
                values = np.column_stack([np.arange(first, first + 100, dtype=float)] * 3)
                publisher.publish(TOPIC, sparkplug(values, first))
            publisher.publish(TOPIC, bytes(2_000_000))  # the broker keeps to the limit that it was told
            while publisher.want_write():
                publisher.loop(0.01)
            blocks = list[SampleBlock]()
            while sum(block.n for block in blocks) < 600:
                block = sensor.read_block()
                assert block is not None
                blocks.append(block)
            numbers = np.concatenate([block.indications[:, 0] for block in blocks])
            assert numbers.tolist() == list(range(begin, begin + 600))
            assert (blocks[0].flags, blocks[0].first_index) == (BlockFlags.RESTART, 600 * (begin // 1000))
            assert sensor.take_drops() == []
            if begin == 0:
                broker.terminate()
                broker.wait(60)
                with pytest.raises(DeviceLost):
                    list(iter(sensor.read_block, "never"))
                broker = started()
    finally:
        sensor.close()
        publisher.disconnect()
        broker.terminate()
        broker.wait(60)


@pytest.mark.parametrize("host", ["mqtt://broker.example.org", "broker.example.org:1883", "a broker"])
def test_a_host_is_a_name_or_an_address_alone(host: str) -> None:
    with pytest.raises(ValidationError, match="give the name or address alone"):
        MqttOptions(host=host, topic="a", rate_hz=100.0)
    assert MqttOptions(host="2001:db8::1", topic="a", rate_hz=100.0).host == "2001:db8::1"
