"""Metrics for Prometheus: what a scrape brings, of a known status and of the real agent."""

from __future__ import annotations

import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from agent.supervision.health import GatewayStatus
from agent.supervision.metrics import serve_metrics
from hw.block import BlockFlags
from hw.virtual.serial_port import PtyDevice, SampleLines
from tests.scenarios.processes import started, wait_until
from tests.unit.test_health import block, opened, report

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scrape(address: str) -> Samples:
    with urllib.request.urlopen(address, timeout=60) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}


def value(samples: Samples, name: str, **labels: str) -> float | None:
    return samples.get((name, frozenset(labels.items())))


def test_a_scrape_brings_the_newest_status() -> None:
    newest: list[GatewayStatus | None] = [None]
    address = serve_metrics("127.0.0.1", 0, lambda: newest[-1])
    assert value(scrape(address), "fieldcal_uptime_seconds") is None
    health = opened(*(block("mems", k) for k in range(4)), block("mems", 5, BlockFlags.GAP))
    newest.append(report(health, 3.0))
    samples = scrape(address)
    mems = {"device": "mems"}
    assert value(samples, "fieldcal_device_up", **mems) == 1
    assert value(samples, "fieldcal_device_samples_total", **mems) == 2500
    assert value(samples, "fieldcal_device_gaps_total", **mems) == 1
    assert value(samples, "fieldcal_device_missing_samples_total", **mems) == 500
    assert value(samples, "fieldcal_device_temperature_celsius", **mems) == pytest.approx(20.5)
    assert value(samples, "fieldcal_device_clock_rate_hertz", **mems) == pytest.approx(1003.3, abs=0.5)
    assert value(samples, "fieldcal_device_temperature_celsius", device="reference") is None, "not known: not there"
    assert value(samples, "fieldcal_state", state="running") == 1
    assert value(samples, "fieldcal_state", state="degraded") == 0
    assert value(samples, "fieldcal_queue_events", queue="pipeline") == 1
    assert value(samples, "fieldcal_unpublished_results") == 0
    assert value(samples, "fieldcal_gateway_info", site="site", gateway="gateway", version="0.1") == 1
    assert value(samples, "fieldcal_calibration_state", sensor="mems", state="VALID") == 0
    assert (value(samples, "process_resident_memory_bytes") or 0) > 1e6


def test_names_are_as_prometheus_wants_them() -> None:
    newest = report(opened(block("mems", 0)), 1.0)
    with urllib.request.urlopen(serve_metrics("127.0.0.1", 0, lambda: newest), timeout=60) as answer:
        lines = [line.split(maxsplit=3) for line in answer.read().decode().splitlines() if line.startswith("# TYPE")]
    kinds = {name: kind for _, _, name, kind in lines if name.startswith("fieldcal_")}
    assert len(kinds) > 30
    for name, kind in kinds.items():
        assert name.endswith("_total") == (kind == "counter"), name
        assert not any(name.endswith(end) for end in ("_ms", "_us", "_ns", "_hz", "_degc", "_mb", "_count")), name


def test_a_browser_finds_a_front_page() -> None:
    newest: list[GatewayStatus | None] = [None]
    address = serve_metrics("127.0.0.1", 0, lambda: newest[-1]).removesuffix("metrics")

    def read(path: str = "") -> tuple[str, str]:
        with urllib.request.urlopen(address + path, timeout=60) as answer:
            return answer.headers["Content-Type"], answer.read().decode()

    assert "No status yet" in read()[1]
    health = opened(block("mems", 0))
    newest.append(msgspec.structs.replace(report(health, 30.0), reasons=["<b>mems</b> is silent"]))
    kind, page = read()
    assert kind == "text/html; charset=utf-8"
    assert "<td>mems</td><td>open</td>" in page
    assert '<a href="/metrics">' in page
    assert "&lt;b&gt;mems" in page
    assert "<b>mems" not in page
    assert read("metrics")[0].startswith("text/plain")
    for path in ("favicon.ico", "nothing?name[]=x", "%2e%2e/etc/passwd"):
        assert "root:" not in read(path)[1]


def test_a_port_that_is_taken_is_told() -> None:
    address = serve_metrics("127.0.0.1", 0, lambda: None)
    with pytest.raises(OSError, match="in use"):
        serve_metrics("127.0.0.1", int(address.split(":")[2].split("/")[0]), lambda: None)


@pytest.mark.thorough
def test_nothing_of_it_loads_where_it_is_off() -> None:
    program = "import agent.acquisition.service, sys; sys.exit('prometheus_client' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


CONFIG = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = 100, axes = 3, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "imu"
prior = {{}}
[zenoh]
enabled = false
[supervision]
status_s = 1
metrics = {{ enabled = true, port = 0 }}
"""


@pytest.fixture
def imu(tmp_path: Path) -> Iterator[PtyDevice]:
    import numpy as np

    # The time since the machine was started would make a line for every sample since then.
    began_s = time.monotonic()
    lines = SampleLines(lambda _, n: np.ones((n, 3)), lambda t_s: int((t_s - began_s) * 100))
    device = PtyDevice(lines, link=tmp_path / "imu")
    device.start()
    yield device
    device.stop()


@pytest.mark.thorough
def test_the_real_agent_is_scraped_on_loopback(tmp_path: Path, imu: PtyDevice) -> None:
    config, output = tmp_path / "gateway.toml", tmp_path / "output"
    config.write_text(CONFIG.format(port=imu.path))
    with started("run", config, "--data-dir", tmp_path / "data", "--log", "json", output=output) as agent:
        line = wait_until(lambda: [x for x in output.read_text().splitlines() if "metrics at" in x], 60, "an address")
        address = line[0].partition("metrics at ")[2].partition('"')[0]
        assert address.startswith("http://127.0.0.1:")
        samples = wait_until(
            lambda: scrape(address) if value(scrape(address), "fieldcal_device_samples_total", device="imu")
            else None, 60, "samples in a scrape",
        )  # fmt: skip
        agent.terminate()
        assert agent.wait(60) == 0
    assert value(samples, "fieldcal_device_up", device="imu") == 1
    assert value(samples, "fieldcal_recording_active") == 1
    assert value(samples, "fieldcal_state", state="running") == 1
