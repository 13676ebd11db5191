"""Results at an MQTT broker: Debian's mosquitto, which is away, slow, killed, or of another mind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from agent.config import ConfigError, Mqtt, parse_config
from agent.config.broker import broker_warning, tls_context
from agent.config.key_file import KeyFileError
from agent.delivery.mqtt import FLYING_MAX, MqttPublisher
from agent.delivery.store import Store
from agent.keys.certificates import issue, make_authority
from agent.setup.machine_checks import broker_findings
from calib.model import PARAMETERS
from tests.unit.broker import OPEN, Broker, Subscriber, free_port, needs_mosquitto
from tests.unit.zenoh_site import record, wait_for

pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)")
TOP = "fieldcal/v1/site/gw"
NOTHING: dict[str, str] = {}


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


Make = Callable[..., MqttPublisher]


@pytest.fixture
def make(store: Store, broker: Broker) -> Iterator[Make]:
    made: list[MqttPublisher] = []

    def make(to: Broker = broker, gateway: str = "gw", **settings: Any) -> MqttPublisher:
        known = {"enabled": True, "port": to.port} | settings
        made.append(
            MqttPublisher("site", gateway, Mqtt.model_validate(known), store.history, poll_s=0.02, pause_s=0.05)
        )
        made[-1].start()
        return made[-1]

    yield make
    for publisher in made:
        publisher.close()


def settled(publisher: MqttPublisher) -> bool:
    state = publisher.state()
    return state.connected and state.waiting == 0


def told(publisher: MqttPublisher, part: str) -> None:
    """Until the state tells this fault."""
    wait_for(lambda: part in publisher.state().fault)


@needs_mosquitto
def test_a_broker_that_comes_late_retains_the_newest_of_each_topic(store: Store, broker: Broker, make: Make) -> None:
    drifts = [record(k, "window", parameter=p, verdict=v) for k, (p, v) in
              enumerate([("Sxx", "drifting"), ("Syy", "drifting"), ("Sxx", "stable")], 3)]  # fmt: skip
    store.commit([record(1, "calibration"), record(2, "clock", device="mems")])
    publisher = make()
    told(publisher, f"127.0.0.1:{broker.port}: the broker cannot be reached: Connection refused; correct mqtt.host")
    for one in drifts:
        publisher.publish(type(one)(**{n: getattr(one, n) for n in one.__slots__} | {"what": "drift"}))
    begun = time.monotonic()
    for k in range(10, 510):
        publisher.publish(record(k, "window"))
    assert time.monotonic() - begun < 10.0
    publisher.tell_status(b'{"state": "running"}')
    broker.start()
    wait_for(lambda: settled(publisher))
    assert publisher.state().superseded == 499 + 1  # windows, and the first verdict on Sxx
    late = Subscriber(broker)
    wait_for(lambda: len(late.came) == 7)
    assert all(retained for _, _, retained in late.came)
    values = {topic.removeprefix(f"{TOP}/"): value for topic, value, _ in late.came}
    assert values["mems/window"] == record(509, "window").payload
    assert values["mems/calibration"] == record(1, "calibration").payload
    verdicts = [json.loads(values[f"mems/drift/{name}"])["verdict"] for name in ("Sxx", "Syy")]
    assert verdicts == ["stable", "drifting"]
    assert (values["status"], values["alive"]) == (b'{"state": "running"}', b"online")
    assert "mems/clock/mems" in values
    publisher.publish(record(600, "status", status="UNCALIBRATED"))  # then no calibration is in force
    wait_for(lambda: late.of(f"{TOP}/mems/calibration")[1:] == [b""])
    publisher.close()
    wait_for(lambda: late.of(f"{TOP}/alive") == [b"online", b"offline"])
    late.close()


@needs_mosquitto
def test_a_killed_broker_gets_the_newest_alone_and_nothing_waits_for_it(broker: Broker, make: Make) -> None:
    broker.start()
    publisher = make()
    publisher.publish(record(1, "calibration"))
    publisher.publish(record(2, "window"))
    wait_for(lambda: settled(publisher))
    broker.kill()
    wait_for(lambda: not publisher.state().connected)
    for k in range(3, 203):
        publisher.publish(record(k, "window"))
    broker.start()
    watching = Subscriber(broker)
    wait_for(lambda: settled(publisher))
    wait_for(lambda: watching.of(f"{TOP}/mems/window") != [])
    # It has forgotten the calibration, which nobody published anew.
    assert watching.of(f"{TOP}/mems/calibration") == [record(1, "calibration").payload]
    assert watching.of(f"{TOP}/mems/window") == [record(202, "window").payload]

    assert broker.process is not None
    os.kill(broker.process.pid, signal.SIGSTOP)  # it answers no more, but the connection stands
    begun = time.monotonic()
    for k in range(1000):
        publisher.publish(record(300 + k, "window", sensor=f"s{k % 100}"))
    assert time.monotonic() - begun < 10.0
    wait_for(lambda: len(publisher._flying) == FLYING_MAX)
    # One of each sensor, and of those in flight a newer one may wait.
    assert 100 <= publisher.state().waiting <= 100 + FLYING_MAX
    os.kill(broker.process.pid, signal.SIGCONT)
    wait_for(lambda: settled(publisher))
    wait_for(lambda: watching.of(f"{TOP}/s99/window")[-1:] == [record(1299, "window", sensor="s99").payload])
    watching.close()


@needs_mosquitto
def test_two_gateways_with_one_client_id_are_told_what_to_do(broker: Broker, make: Make) -> None:
    broker.start()
    watching = Subscriber(broker, f"{TOP}/alive")
    first = make(client_id="one")
    wait_for(lambda: settled(first))
    second = make(client_id="one", gateway="gw-2")
    own = "the client_id 'one': state an mqtt.client_id of its own for each gateway"
    told(first, f"the connection to the broker ended: no reason told; if this repeats, another program has {own}")
    told(second, own)
    wait_for(lambda: watching.of(f"{TOP}/alive")[:2] == [b"online", b"offline"])  # the last will
    watching.close()


@needs_mosquitto
def test_password_rights_and_limits_of_the_broker(tmp_path: Path, make: Make) -> None:
    (tmp_path / "acl").write_text(f"user gw\ntopic write {TOP}/mems/#\ntopic read #\n")
    subprocess.run(["mosquitto_passwd", "-b", "-c", tmp_path / "passwords", "gw", "right"], check=True)
    for name in ("acl", "passwords"):
        (tmp_path / name).chmod(0o644)
    password = tmp_path / "password"
    password.write_text("wrong\n")
    password.chmod(0o600)
    lines = f"password_file {tmp_path}/passwords\nacl_file {tmp_path}/acl\nmax_packet_size 1000\n"
    guarded = Broker(tmp_path, lines).start()
    try:
        publisher = make(guarded, username="gw", password_file=password)
        told(publisher, "the broker refuses the connection: Not authorized; correct mqtt.username and mqtt.password")
        publisher.close()
        password.write_text("right\r\nand a second line\n")
        publisher = make(guarded, username="gw", password_file=password)
        publisher.publish(record(1, "calibration"))
        told(publisher, f"{TOP}/mems/calibration: {len(record(1, 'calibration').payload)}"[:-3])
        assert "bytes, but the broker takes 1000 at most" in "".join(publisher._faults.values())
        publisher.publish(record(2, "window"))
        publisher.publish(record(3, "window", sensor="spare"))
        wait_for(lambda: f"{TOP}/spare/window" in publisher._faults)
        assert "the broker refuses it: Not authorized; correct" in publisher._faults[f"{TOP}/spare/window"]
        wait_for(lambda: settled(publisher))
        assert publisher.state().refused == 3  # with `alive`
    finally:
        guarded.kill()


@needs_mosquitto
def test_doctor_tries_the_broker_beside_a_running_agent(tmp_path: Path, broker: Broker, make: Make) -> None:
    def found(broker: Broker, **more: Any) -> tuple[str, str]:
        mqtt = {"enabled": True, "port": broker.port, **more}
        device = {"name": "a", "driver": "serial-csv", "options": {"port": "none", "rate_hz": 100}}
        devices = {"devices": [device], "channels": [{"sensor": "a", "prior": {"sensitivity": 1.0}}]}
        config = parse_config({"gateway": {"site": "site", "name": "gw"}, "mqtt": mqtt, **devices}, "")
        (finding,) = broker_findings(config, tmp_path)
        return finding.verdict, finding.says

    (tmp_path / "password").write_text("wrong\n")
    (tmp_path / "password").chmod(0o600)
    assert found(broker) == (
        "advice", f"127.0.0.1:{broker.port}: the broker cannot be reached: Connection refused; correct mqtt.host and "
        "mqtt.port")  # fmt: skip
    watching = Subscriber(broker.start())
    agent = make()
    wait_for(lambda: settled(agent))
    assert found(broker) == ("good", f"127.0.0.1:{broker.port} takes the connection")
    agent.publish(record(1, "window"))
    wait_for(lambda: bool(watching.of(f"{TOP}/mems/window")))
    assert watching.of(f"{TOP}/alive") == [b"online"]  # the agent has kept its connection, and no will came
    watching.close()
    (tmp_path / "none").touch(mode=0o644)
    guarded = Broker(tmp_path, f"allow_anonymous false\npassword_file {tmp_path}/none\n").start()
    try:
        verdict, says = found(guarded, username="gw", password_file=str(tmp_path / "password"))
        assert (verdict, "correct mqtt.username and mqtt.password_file" in says) == ("advice", True)
    finally:
        guarded.kill()


def make_files(directory: Path) -> dict[str, Path]:
    now = datetime.now(UTC)
    ours, others = make_authority("ours", 10, now), make_authority("others", 10, now)
    gateway, server = issue(ours, "gw", 10, now), issue(ours, "broker", 10, now, ["127.0.0.1"])
    found = {"ca": ours.certificate_pem, "other": others.certificate_pem, "certificate": gateway.certificate_pem,
             "key": gateway.key_pem, "broker": server.certificate_pem, "broker.key": server.key_pem}  # fmt: skip
    for name, data in found.items():
        (directory / name).write_bytes(data)
        (directory / name).chmod(0o600)
    return {name: directory / name for name in found}


# The library leaves the socket of a failed handshake to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@needs_mosquitto
def test_tls_with_the_right_and_with_another_authority(tmp_path: Path, make: Make) -> None:
    files = make_files(tmp_path)
    server = f"cafile {files['ca']}\ncertfile {files['broker']}\nkeyfile {files['broker.key']}\n"
    secure = Broker(tmp_path, f"{OPEN}{server}require_certificate true\n").start()
    ours = {name: files[name] for name in ("ca", "certificate", "key")}
    try:
        publisher = make(secure, tls=ours)
        publisher.publish(record(1, "window"))
        wait_for(lambda: settled(publisher))
        wrong = make(secure, tls=ours | {"ca": files["other"]})
        told(
            wrong, "the broker's certificate is not trusted: self-signed certificate in certificate chain; mqtt.tls.ca"
        )
        told(make(secure, tls=ours, host="localhost"), "is not trusted: Hostname mismatch")
        told(make(secure), "127.0.0.1")  # without TLS there is no answer
        told(make(secure, tls={"ca": files["ca"]}), "127.0.0.1")  # the broker asks for a certificate
    finally:
        secure.kill()


@pytest.mark.parametrize(("host", "tls", "warned"), [("192.0.2.1", False, True), ("192.0.2.1", True, False),
                                                     ("127.0.0.1", False, False)])  # fmt: skip
def test_a_password_without_tls_is_told(host: str, tls: bool, warned: bool) -> None:
    settings = Mqtt.model_validate({"enabled": True, "host": host, "username": "u", "password_file": "p",
                                    **({"tls": {"ca": "c"}} if tls else {})})  # fmt: skip
    assert ("not encrypted; add [mqtt.tls]" in broker_warning(settings)) == warned


def test_what_answers_and_is_no_broker_is_told(make: Make, broker: Broker) -> None:
    import socket
    import threading

    with socket.create_server(("127.0.0.1", broker.port)) as server:

        def answer() -> None:
            for _ in range(3):
                held, _ = server.accept()
                held.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                held.close()

        threading.Thread(target=answer, daemon=True).start()
        publisher = make()
        wait_for(lambda: f"127.0.0.1:{broker.port}" in publisher.state().fault)
        publisher.publish(record(1, "window"))
        assert publisher.state().waiting == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"topic": "a/+/b"}, "without +, #"),
        ({"topic": "#"}, "without +, #"),
        ({"topic": "a//b"}, "names with / between them"),
        ({"topic": "/a"}, "names with / between them"),
        ({"topic": "a\0b"}, "control characters"),
        ({"topic": "$SYS/a"}, "not $ at the front"),
        ({"topic": "a\ud800"}, "unicode"),
        ({"topic": "a" * 201}, "200 characters"),
        ({"home_assistant": "home/#"}, "without +, #"),
        ({"host": "mqtt://broker"}, "give the name or address alone"),
        ({"host": "a\0b"}, "give the name or address alone"),
        ({"password_file": "p"}, "a password needs a username"),
        ({"tls": {"ca": "c", "key": "k"}}, "certificate and key belong together"),
    ],
)  # fmt: skip
def test_hostile_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words.replace("+", r"\+").replace("$", r"\$")):
        Mqtt.model_validate(settings)


def test_files_of_the_broker_are_checked_as_other_secrets(tmp_path: Path) -> None:
    files = make_files(tmp_path)
    password = tmp_path / "password"
    password.write_text("secret\n")
    password.chmod(0o644)
    raw = {"devices": [{"name": "a", "driver": "virtual"}], "channels": [{"sensor": "a"}],
           "mqtt": {"enabled": True, "username": "u", "password_file": str(password),
                    "tls": {"ca": str(tmp_path / "missing")}}}  # fmt: skip
    with pytest.raises(ConfigError) as error:
        parse_config(raw, "gateway.toml")
    said = str(error.value)
    assert f"mqtt.password_file: {password}: other users can read" in said
    assert "run chmod 600" in said
    assert "mqtt.tls: " in said
    assert "No such file" in said
    assert "secret" not in said
    for wrong, words in (
        ({"ca": files["key"]}, "no certificates in PEM"),
        ({"ca": files["ca"], "certificate": files["broker"], "key": files["key"]}, "that belongs to the key"),
    ):
        with pytest.raises(KeyFileError, match=words):
            tls_context(Mqtt.model_validate({"tls": wrong}).tls)  # type: ignore[arg-type]
    files["key"].chmod(0o640)
    with pytest.raises(KeyFileError, match="run chmod 600"):
        tls_context(Mqtt.model_validate({"tls": {n: files[n] for n in ("ca", "certificate", "key")}}).tls)  # type: ignore[arg-type]


@needs_mosquitto
def test_home_assistant_finds_entities_whose_templates_give_the_results(broker: Broker, make: Make) -> None:
    jinja2 = pytest.importorskip("jinja2", reason="jinja2 is not installed")
    broker.start()
    watching = Subscriber(broker)
    make(gateway="gw.1").publish(record(1, "calibration"))
    publisher = make(home_assistant="homeassistant", gateway="gw.2")
    publisher.publish(record(1, "calibration", standard_uncertainty=[6.0] * 11 + [None]))
    publisher.publish(record(2, "status", status="HELD"))
    publisher.tell_status(b'{"state": "degraded"}')
    wait_for(lambda: settled(publisher))
    wait_for(lambda: any(topic.endswith("gw.2/status") for topic, _, _ in watching.came))
    found = {topic: json.loads(value) for topic, value, _ in watching.came if topic.startswith("homeassistant/")}
    assert not any("gw.1" in str(config) for config in found.values())  # off by default
    assert len({config["unique_id"] for config in found.values()}) == len(found) == 1 + 2 + 3 * 12
    newest = {topic: value for topic, value, _ in watching.came}
    environment = jinja2.Environment()
    environment.filters["timestamp_custom"] = lambda t, form, local: datetime.fromtimestamp(
        t, None if local else UTC
    ).strftime(form)
    states = {}
    for topic, config in found.items():
        assert all(part.replace("-", "").replace("_", "").isalnum() for part in topic.split("/"))
        assert newest[config["availability_topic"]] == b"online"
        value = newest.get(config["state_topic"])
        if value is not None:
            states[config["name"]] = environment.from_string(config["value_template"]).render(
                value_json=json.loads(value)
            )
    assert states["problem"] == "ON"
    assert states["status"] == "HELD"
    assert states["calibrated"] == "2023-11-14T22:13:20+00:00"
    S = [26154.0, 120.0, 50.0, -195.0, 26123.0, 67.0, -81.0, 87.0, 26295.0]
    assert [float(states[name]) for name in PARAMETERS] == [*S, 250.0, 250.0, 250.0]
    assert [float(states[f"U({name})"]) for name in PARAMETERS[:11]] == [12.0] * 11
    assert states["U(Qz)"] == "None"  # unknown
    by_name = {config["name"]: config for config in found.values()}
    assert [by_name[n].get("unit_of_measurement") for n in ("Sxx", "Qz")] == ["count/(m/s²)", "count"]
    classes = [by_name[n]["device_class"] for n in ("problem", "status", "calibrated", "drift of Sxx")]
    assert classes == ["problem", "enum", "timestamp", "enum"]
    assert set(PARAMETERS) < set(by_name)
    empty = environment.from_string(by_name["Sxx"]["value_template"]).render()  # a withdrawn calibration
    assert empty == "None"
    watching.close()


def test_a_port_that_nothing_listens_at_costs_the_end_nothing(store: Store) -> None:
    publisher = MqttPublisher("site", "gw", Mqtt(enabled=True, port=free_port()), store.history)
    publisher.start()
    told(publisher, "Connection refused")
    begun = time.monotonic()
    publisher.close(60.0)
    assert time.monotonic() - begun < 30.0
