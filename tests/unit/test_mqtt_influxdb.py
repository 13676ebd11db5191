"""From the gateway through a broker into InfluxDB, by examples/mqtt_to_influxdb.py."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
import urllib.error
import urllib.parse
import urllib.request
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from agent.config import Mqtt
from agent.core.events import RESULTS, CalibrationUpdate, DriftReport, StatusChange
from agent.delivery.mqtt import MqttPublisher
from agent.delivery.store import Store
from tests.unit.broker import Broker, free_port, needs_mosquitto
from tests.unit.results import calibration
from tests.unit.zenoh_site import record, wait_for

pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed (extra mqtt)")
ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "mqtt_to_influxdb.py"
MQTT = ROOT / "deploy" / "mqtt"
INFLUXD = """reporting-disabled = true
bind-address = "127.0.0.1:{other}"
[meta]
dir = "{dir}/meta"
[data]
dir = "{dir}/data"
wal-dir = "{dir}/wal"
[http]
bind-address = "127.0.0.1:{port}"
"""


@pytest.fixture(scope="module")
def example() -> Any:
    spec = spec_from_file_location("mqtt_to_influxdb", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_hostile_names_and_values_stay_within_their_line(example: Any) -> None:
    topic = "fieldcal/v1/a b,c=d/g\n2/s\\/window"
    line = example.line_of(topic, json.dumps({"t_utc_ns": 5, "x y": 1, "s": 'a"\nb\\', "big": 1 << 2000}).encode())
    assert line == 'window,gateway=g_2,sensor=s_,site=a_b_c_d t_utc_ns=5.0,x_y=1.0,s="a\' b/" 5'
    for value in (b"", b"online", b"[]", b'{"t_utc_ns": 1e99}', b'{"t_utc_ns": null}', b"[" * 100_000, b"\xff"):
        assert example.line_of(topic, value) is None
    assert example.line_of("fieldcal/v1/a", b'{"t_utc_ns": 1}') is None


def queries(measurement: str) -> list[str]:
    """Those of the dashboard of Grafana."""
    told = [target["query"] for panel in json.loads((MQTT / "grafana.json").read_text())["panels"]
            for target in panel["targets"]]  # fmt: skip
    return [query for query in told if f'FROM "{measurement}"' in query]


def test_telegraf_and_grafana_know_the_topics_and_the_fields() -> None:
    from paho.mqtt.client import topic_matches_sub

    (given,) = tomllib.loads((MQTT / "telegraf.conf").read_text())["inputs"]["mqtt_consumer"]
    top = "fieldcal/v1/site/gw/mems"
    for topic in (f"{top}/calibration", f"{top}/status", f"{top}/window", f"{top}/drift/Sxx"):
        assert sum(topic_matches_sub(sub, topic) for sub in given["topics"]) == 1
        (parsed,) = (each for each in given["topic_parsing"] if topic_matches_sub(each["topic"], topic))
        named = dict(zip(parsed["tags"].split("/"), topic.split("/"), strict=True))
        assert named.items() >= {"site": "site", "gateway": "gw", "sensor": "mems"}.items()
        place = parsed["measurement"].split("/").index("measurement")
        assert topic.split("/")[place] in ("calibration", "status", "window", "drift")
    told = {name for kind in (DriftReport, StatusChange, CalibrationUpdate) for name in kind.__struct_fields__}
    assert told.issuperset(given["json_string_fields"])
    for kind, field in (("status", "status"), ("drift", "change")):
        assert [f'SELECT "{field}"' in query for query in queries(kind)] == [True]
        assert field in RESULTS[kind].__struct_fields__


def ask(address: str, **query: str) -> Any:
    data = urllib.parse.urlencode(query).encode()
    with urllib.request.urlopen(urllib.request.Request(f"{address}/query", data), timeout=60) as answer:
        return json.loads(answer.read())


@needs_mosquitto
@pytest.mark.skipif(shutil.which("influxd") is None, reason="needs Debian's influxdb")
def test_a_calibration_arrives_in_influxdb(tmp_path: Path) -> None:
    port = free_port()
    config = tmp_path / "influxdb.conf"
    config.write_text(INFLUXD.format(dir=tmp_path, port=port, other=free_port()))
    address = f"http://127.0.0.1:{port}"
    database = subprocess.Popen(["influxd", "-config", config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    broker, store, made = Broker(tmp_path).start(), Store(tmp_path, 0), calibration(1)
    writer = None
    try:

        def ready() -> bool:
            try:
                return "results" in ask(address, q="CREATE DATABASE fieldcal")
            except OSError:
                return False

        wait_for(ready)
        url = f"{address}/write?db=fieldcal&precision=ns"
        writer = subprocess.Popen([sys.executable, EXAMPLE, "127.0.0.1", str(broker.port), url])
        publisher = MqttPublisher("site", "gw", Mqtt(enabled=True, port=broker.port), store.history, poll_s=0.02)
        publisher.start()
        publisher.publish(record(1, "calibration"))
        rows: list[Any] = []

        def came() -> bool:
            select = "SELECT sensitivity_0_0, standard_uncertainty_11, output_unit, sensor, gateway FROM calibration"
            found = ask(address, q=select, db="fieldcal", epoch="ns")["results"][0]
            rows[:] = found["series"][0]["values"] if "series" in found else []
            return bool(rows)

        wait_for(came)
        assert rows == [[made.t_utc_ns, made.sensitivity[0][0], made.standard_uncertainty[11], "count", "mems", "gw"]]
        assert len(queries("calibration")) == 9
        for query in queries("calibration"):
            shown = (
                query.replace("$timeFilter", "time > 0").replace("^$gateway$", "^gw$").replace("^$sensor$", "^mems$")
            )
            assert "series" in ask(address, q=shown, db="fieldcal")["results"][0], query
        publisher.close()
    finally:
        for process in (writer, database):
            if process is not None:
                process.kill()
                process.wait()
        broker.kill()
        store.close()
