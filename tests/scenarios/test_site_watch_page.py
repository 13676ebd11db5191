"""What a site suspects of a sensor, on the page: its card, its view, what is exported."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.results import calibration, status
from tests.unit.test_fleet_watch import lines
from tests.unit.test_monitor_watch import received
from tests.unit.zenoh_site import Site

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from tests.unit.monitor_site import Served


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@needs_chromium
@pytest.mark.thorough
def test_a_suspected_sensor_on_the_page(site: Site, tmp_path: Path, browser: Any) -> None:
    with Served(site, tmp_path / "monitor") as served:
        rows = lines()
        for k in range(0, len(rows), 500):
            served.database.add([received(row) for row in rows[k : k + 500]])
        for gateway, sensor in (("middle", "c"), ("middle", "d")):
            served.fleet.set_alive("bridge", gateway, True)
            for result in (calibration(1), status(2)):
                fields = msgspec.json.decode(msgspec.json.encode(result)) | {"sensor": sensor}
                served.fleet.take("bridge", gateway, sensor, result.what, fields)
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open()
        page.get_by_text("Nothing needs a person").wait_for()
        served.watching.step()
        served.fleet.alarms()
        page.locator("#new-cards").click()
        card = page.locator("#cards .card")
        card.get_by_text("Suspected: Sensitivity of z fell by 2.9").wait_for()
        said = card.inner_text()
        assert "The structure says so" in said
        assert "gravity contradicts it" in said
        assert "So rather the structure at the sensor, or its mount, has changed" in said
        larger = re.search(r"Values of today may be used with a larger U: ± ([0-9.]+) %", said)
        assert larger is not None, said
        assert 5.8 < float(larger[1]) < 6.2  # twice the change of 2.9 %, with its u and that of the calibration
        assert "fieldcal visit gateway.toml --data-dir visit --sensor c" in said
        assert page.locator("#counts button", has_text="suspected").inner_text().split() == ["1", "suspected"]
        card.locator("h3 a").click()
        own = page.locator("#site-watch-card")
        own.get_by_text("sensitivity: sensitivity of z").wait_for()
        assert "1 of 6" in own.inner_text()
        assert "no sensor stands beside a reference" in own.inner_text()
        page.goto(f"http://{served.address}/#site=bridge&gateway=middle&sensor=d")
        own.get_by_text("none", exact=True).wait_for()
        exported = page.request.get(f"http://{served.address}/watch.csv").text()
        told = {row["sensor"]: row for row in csv.DictReader(io.StringIO(exported))}
        assert told["c"]["suspected"].startswith("sensitivity of z has fallen by 2.9")
        assert told["d"]["suspected"] == ""
        fleet = csv.DictReader(io.StringIO(page.request.get(f"http://{served.address}/fleet.csv").text()))
        kinds = {row["sensor"]: (row["kind"], row["suspected"]) for row in fleet}
        assert kinds["d"] == ("sound", "")
        assert kinds["c"][0] == "suspected"
        assert '"u_pct": ' in kinds["c"][1]
        watched.close()
