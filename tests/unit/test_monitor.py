"""The fleet page through a real bus: what is shown, and kept over a restart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.unit.zenoh_site import Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from tests.unit.monitor_site import Monitor

HOSTILE = "<img src=x onerror=\"document.title='owned'\">"


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Publisher]:
    store = Store(tmp_path / "gateway")
    publisher = Publisher("site", "gw", [site.endpoint], store)
    first = store.last_sequence() + 1
    store.commit([record(first, "calibration"), record(first + 1, "status", status="HELD", reason=HOSTILE),
                  record(first + 2, "window", used=True)])  # fmt: skip
    publisher.start()
    yield publisher
    publisher.close()
    store.close()


def test_a_sensor_is_shown_with_why_and_kept_over_a_restart(site: Site, gateway: Publisher, tmp_path: Path) -> None:
    monitor = Monitor(site, tmp_path / "monitor")
    try:
        wait_for(lambda: [r["status"] for r in monitor.sensors()] == ["HELD"])
        (row,) = monitor.sensors()
        assert (row["sensor"], row["gateway_state"], row["why"]) == ("mems", "", f"HELD: {HOSTILE}")
        gateway.close()
        wait_for(lambda: "not on the bus" in monitor.sensors()[0]["why"])
    finally:
        monitor.stop()
    monitor = Monitor(site, tmp_path / "monitor")  # now without the gateway
    try:
        (row,) = monitor.sensors()
        assert row["why"] == f"HELD: {HOSTILE}; the gateway is not on the bus"
        asked = "site=site&gateway=gw&sensor=mems&what="
        assert len(monitor.get(f"api/history?{asked}calibration")) == 1
        assert "count" in monitor.get(f"sensor.csv?{asked}calibration")
    finally:
        monitor.stop()
