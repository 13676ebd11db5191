"""The fleet page through a real bus: what is shown, and kept over a restart."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgspec
import pytest
from click.testing import CliRunner

from agent.cli.fleet import fleet as fleet_command
from agent.core.events import DriftReport
from agent.delivery.keys import Address
from agent.delivery.publication import Publisher
from agent.delivery.received import Received
from agent.delivery.record import StoredResult
from agent.delivery.store import Store
from agent.keys.certificates import issue, make_authority
from agent.keys.files import write_new
from tests.unit.test_fleet_watch import lines, report
from tests.unit.zenoh_site import Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from tests.unit.monitor_site import Monitor, Served, many

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


@pytest.mark.thorough
def test_a_sensor_is_shown_with_why_and_kept_over_a_restart(site: Site, gateway: Publisher, tmp_path: Path) -> None:
    monitor = Monitor(site.endpoint, tmp_path / "monitor")
    try:
        wait_for(lambda: [r["status"] for r in monitor.sensors()] == ["HELD"])
        (row,) = monitor.sensors()
        assert (row["sensor"], row["gateway_state"], row["why"]) == ("mems", "", f"HELD: {HOSTILE}")
        gateway.close()
        wait_for(lambda: "not on the bus" in monitor.sensors()[0]["why"])
    finally:
        monitor.stop()
    monitor = Monitor(site.endpoint, tmp_path / "monitor")  # now without the gateway
    try:
        (row,) = monitor.sensors()
        assert row["why"] == f"HELD: {HOSTILE}; the gateway is not on the bus"
        asked = "site=site&gateway=gw&sensor=mems&what="
        assert len(monitor.get(f"api/history?{asked}calibration")) == 1
        assert "count" in monitor.get(f"sensor.csv?{asked}calibration")
    finally:
        monitor.stop(signal.SIGTERM)


@pytest.mark.thorough
def test_hours_of_the_bus_are_kept_and_read_while_the_monitor_runs(site: Site, tmp_path: Path) -> None:
    """From a gateway's store over the bus into the database; `fieldcal fleet watch` reads it meanwhile."""
    rows = [row for row in lines()[: 6 * 24] if row["sensor"] == "c"]
    with ExitStack() as opened:
        store = opened.enter_context(closing(Store(tmp_path / "gateway")))
        first = store.last_sequence() + 1
        publisher = Publisher("site", "gw", [site.endpoint], store)
        monitor = Monitor(site.endpoint, tmp_path / "monitor")
        opened.callback(monitor.stop)
        publisher.start()
        opened.callback(publisher.close)

        def send(result: StoredResult) -> None:
            store.commit([result])
            publisher.publish(result)

        send(record(first, "status", sensor="c", status="HELD", reason="none"))
        wait_for(lambda: bool(monitor.sensors()))  # of a gateway that it meets, it has no older results
        for k, row in enumerate(rows, start=1):
            send(StoredResult.of(report(row, first + k), recorded=True, recording="", epoch=store.epoch))
        file = tmp_path / "monitor" / "monitor.sqlite"

        def read() -> dict[str, Any]:
            told = CliRunner().invoke(fleet_command, ["watch", str(file), "--json", "-"], standalone_mode=False)
            found: dict[str, Any] = json.loads(told.stdout) if told.stdout else {}
            return found

        wait_for(lambda: read().get("lines") == 24)
        assert [(one["gateway"], one["sensor"], one["verdict"]) for one in read()["sensors"]] == [
            ("gw", "c", "learning")
        ]
        assert monitor.get("api/watch?site=site") is None, "no day has closed"


def test_a_drift_stays_one_over_a_restart(site: Site, tmp_path: Path) -> None:
    place = ("site", "gw", "mems")
    with Served(site, tmp_path / "monitor") as served:
        verdicts: tuple[Literal["drifting", "stepped"], ...] = ("drifting", "stepped")
        for number, told in enumerate(verdicts, start=1):
            drift = DriftReport(run_id="r", sequence=number, sensor="mems", t_utc_ns=number, parameter="Sxx",
                                verdict=told, change=1.0, u_change=1.0, rate=0.0, u_rate=0.0, onset_utc_ns=1,
                                statistic=1.0, threshold=1.0, false_alarms_a_year=0.1, reason="r")  # fmt: skip
            fields = json.loads(msgspec.json.encode(drift))
            served.database.add([Received("", Address(*place, "drift"), number, fields, None)])
    with Served(site, tmp_path / "monitor") as served:
        served.fleet.set_alive("site", "gw", True)
        (row,) = served.fleet.rows()
        assert (row["kind"], row["verdicts"][0]["first_utc_ns"]) == ("drifting", 1)
        assert len(served.fleet.events()) == 1


@pytest.mark.thorough
def test_over_https_a_user_logs_in_with_a_cookie_of_this_host(tmp_path: Path) -> None:
    """While no router answers: Ctrl-C ends the monitor well all the same.

    And while more connections do not finish the handshake of TLS than the program may have files open.
    """
    pytest.importorskip("argon2", reason="the extra monitor is not installed")
    from agent.monitor.users import set_user

    authority = make_authority("authority", 10, datetime.now(UTC))
    server = issue(authority, "fleet", 10, datetime.now(UTC), ["127.0.0.1"])
    write_new(tmp_path, {"ca.pem": authority.certificate_pem, "fleet.pem": server.certificate_pem,
                         "fleet.key": server.key_pem})  # fmt: skip
    set_user(tmp_path / "users.txt", "anna", (), "correct horse battery staple")
    options = ["--https-certificate", str(tmp_path / "fleet.pem"), "--https-key", str(tmp_path / "fleet.key"),
               "--users", str(tmp_path / "users.txt")]  # fmt: skip
    monitor = Monitor("tcp/127.0.0.1:1", tmp_path / "monitor", *options, ca=tmp_path / "ca.pem", files=300)
    idle = ExitStack()
    try:
        idle.enter_context(many(monitor.address, 1024))
        body = json.dumps({"name": "anna", "password": "correct horse battery staple"}).encode()
        login = Request(f"{monitor.url}/api/login", body, {"Origin": monitor.url})
        with urlopen(login, timeout=60, context=monitor.tls) as answer:
            cookie = answer.headers["Set-Cookie"].split(";")
        assert cookie[0].startswith("__Host-fieldcal=")
        assert {"secure", "httponly", "samesite=strict"} <= {part.strip().lower() for part in cookie[1:]}
        asked = Request(f"{monitor.url}/api/fleet", headers={"Cookie": cookie[0]})
        with urlopen(asked, timeout=60, context=monitor.tls) as answer:
            assert json.loads(answer.read())["sensors"] == []
        with pytest.raises(HTTPError, match="401"):
            monitor.get("api/fleet")
    finally:
        idle.close()
        said = monitor.stop()
    assert len(said) < 2000, said[:2000]
