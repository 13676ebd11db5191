"""Metrics of calibrations, the alert rules on them, and the dashboard: by promtool and a real Prometheus."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.core.events import DriftReport, Tick
from agent.supervision.health import GatewayStatus
from agent.supervision.metrics import serve_metrics
from tests.scenarios.processes import wait_until
from tests.unit.results import calibration, status
from tests.unit.test_health import START_NS, block, opened, report
from tests.unit.test_metrics import scrape, value

GRAFANA = Path(__file__).parents[2] / "deploy" / "grafana"
PROMETHEUS, PROMTOOL = shutil.which("prometheus"), shutil.which("promtool")
NAME = re.compile(r"\bfieldcal_\w+")


def drift(sequence: int, verdict: str) -> DriftReport:
    return DriftReport(
        run_id="r", sequence=sequence, sensor="mems", t_utc_ns=1, parameter="Sxx", verdict=verdict,  # type: ignore[arg-type]
        change=1.0, u_change=0.1, rate=0.1, u_rate=0.01, onset_utc_ns=1, statistic=9.0, threshold=5.0,
        false_alarms_a_year=0.1, reason="",
    )  # fmt: skip


def gateway(*results: Any) -> GatewayStatus:
    health = opened(block("mems", 0))
    health.update(Tick(t_monotonic_ns=START_NS, t_utc_ns=0), list(results))
    return msgspec.structs.replace(report(health, 1.0), t_utc_ns=time.time_ns())


def test_sensitivity_offset_u_date_and_drift() -> None:
    newest = gateway(calibration(3, qz_known=False), status(4), drift(5, "stable"), drift(6, "drifting"))
    samples = scrape(serve_metrics("127.0.0.1", 0, lambda: newest))
    mems, unit = {"sensor": "mems"}, {"unit": "count"}
    assert value(samples, "fieldcal_calibration_sensitivity", **mems, **unit, output="y", direction="x") == -195.0
    name = "fieldcal_calibration_sensitivity_expanded_uncertainty"
    assert value(samples, name, **mems, **unit, output="y", direction="x") == 12.0
    assert value(samples, "fieldcal_calibration_offset", **mems, **unit, output="x") == 250.0
    assert value(samples, "fieldcal_calibration_offset_expanded_uncertainty", **mems, **unit, output="x") == 80.0
    assert value(samples, "fieldcal_calibration_offset", **mems, **unit, output="z") is None  # not known
    assert value(samples, "fieldcal_calibration_coverage_factor", **mems) == 2.0
    assert value(samples, "fieldcal_calibration_timestamp_seconds", **mems) == pytest.approx(1.7e9, abs=1e-3)
    for verdict, holds in {"stable": 0, "drifting": 1, "stepped": 0}.items():
        assert value(samples, "fieldcal_drift_state", **mems, parameter="Sxx", state=verdict) == holds


def test_a_restart_is_not_a_calibration() -> None:
    made = calibration(3)
    restored = msgspec.structs.replace(
        made, run_id="later", sequence=90, t_utc_ns=made.t_utc_ns + 10**18,
        made_run_id="r", made_sequence=3, made_utc_ns=made.t_utc_ns,
    )  # fmt: skip
    before, after = gateway(made).sensors["mems"], gateway(restored).sensors["mems"]
    assert before.in_force == after.in_force
    assert (before.calibrations, after.calibrations) == (1, 0)


def test_verdicts_of_earlier_runs_are_remembered() -> None:
    health = opened(block("mems", 0))
    health.remember(
        [drift(1, "stable"), drift(2, "drifting"), msgspec.structs.replace(drift(3, "stepped"), sensor="?")]
    )
    assert report(health, 1.0).sensors["mems"].drifts == {"Sxx": "drifting"}


@pytest.mark.slow
@pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (Debian's package prometheus)")
def test_the_rules_by_promtool() -> None:
    done = subprocess.run([str(PROMTOOL), "test", "rules", "fieldcal.test.yml"], cwd=GRAFANA, capture_output=True,
                          text=True, timeout=60, check=False)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def expressions() -> list[str]:
    board = json.loads((GRAFANA / "fieldcal.json").read_text("utf-8"))
    return [target["expr"] for panel in board["panels"] for target in panel["targets"]]


def test_dashboard_and_rules_use_metrics_that_there_are() -> None:
    newest = gateway(calibration(3), status(4), drift(6, "drifting"))
    there = {name for name, _ in scrape(serve_metrics("127.0.0.1", 0, lambda: newest))}
    rules = (GRAFANA / "fieldcal.rules.yml").read_text("utf-8")
    used = {name for text in (*expressions(), *re.findall("expr: (.*)", rules)) for name in NAME.findall(text)}
    assert len(used) >= 10
    assert used <= there


@pytest.mark.skipif(importlib.util.find_spec("grafana_foundation_sdk") is None,
                    reason="grafana-foundation-sdk is not installed")  # fmt: skip
def test_the_dashboard_is_what_its_script_makes() -> None:
    spec = importlib.util.spec_from_file_location("dashboard", GRAFANA / "dashboard.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    made = script.JSONEncoder(sort_keys=True, indent=2).encode(script.built())
    assert made + "\n" == (GRAFANA / "fieldcal.json").read_text("utf-8")


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[str]:
    """A Prometheus with the rules, which scrapes a gateway with a drifting sensor and one that does not answer."""
    newest = gateway(calibration(3), status(4), drift(6, "drifting"))
    address = serve_metrics("127.0.0.1", 0, lambda: newest)
    alive, silent, port = address.split("/")[2], f"127.0.0.1:{free_port()}", free_port()
    rules = (GRAFANA / "fieldcal.rules.yml").read_text("utf-8")
    (tmp_path / "rules.yml").write_text(re.sub(r"for: 2m", "for: 1s", rules))  # promtool tests the two minutes
    (tmp_path / "prometheus.yml").write_text(json.dumps({
        "global": {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"},
        "rule_files": ["rules.yml"],
        "scrape_configs": [{"job_name": "fieldcal", "static_configs": [{"targets": [alive, silent]}]}],
    }))  # fmt: skip
    command = [str(PROMETHEUS), f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data",
               f"--web.listen-address=127.0.0.1:{port}", "--log.level=error"]  # fmt: skip
    with subprocess.Popen(command) as process:
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()


def ask(address: str, path: str, **arguments: str) -> Any:
    with urllib.request.urlopen(f"{address}/api/v1/{path}?{urllib.parse.urlencode(arguments)}", timeout=60) as answer:
        return json.load(answer)["data"]


@pytest.mark.slow
@pytest.mark.skipif(PROMETHEUS is None, reason="prometheus is not installed (Debian's package prometheus)")
def test_a_real_prometheus_fires_for_a_drifting_sensor_and_a_silent_gateway(prometheus: str) -> None:
    def firing() -> set[str] | None:
        try:
            alerts = ask(prometheus, "alerts")["alerts"]
        except OSError:
            return None
        found = {alert["labels"]["alertname"] for alert in alerts if alert["state"] == "firing"}
        return found if "FieldcalGatewaySilent" in found else None

    # the calibration is of 2023
    expected = {"FieldcalSensorDrifts", "FieldcalGatewaySilent", "FieldcalCalibrationOld"}
    assert wait_until(firing, 60, "the alert of the silent gateway") == expected
    for expression in expressions():
        asked = expression.replace("$gateway", ".*").replace("$sensor", ".*")
        found = ask(prometheus, "query", query=asked)["result"]
        assert found or "increase(" in asked, expression  # an increase needs an hour
