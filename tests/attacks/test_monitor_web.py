"""What strangers on the web and on the bus may send to the fleet page: refused, bounded, or shown as text."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from msgspec import structs

from agent.core.events import DriftReport, Estimate, Result, SharedError
from agent.delivery.guide import (
    Ending,
    Expanded,
    Guide,
    MadeFile,
    NextStop,
    Staying,
    TakenStop,
    Warned,
    read_guide,
)
from agent.delivery.keys import Address
from agent.delivery.received import Received
from tests.attacks.signed_site import KEY, OTHER, Gateway, listed
from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.results import calibration, clock, status, window
from tests.unit.zenoh_site import Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from agent.monitor import fleet as fleet_module
from agent.monitor.fleet import Fleet
from tests.unit.monitor_site import Served


@pytest.fixture
def served(site: Site, tmp_path: Path) -> Iterator[Served]:
    with Served(site, tmp_path / "monitor", names=["fleet.example.org"]) as server:
        yield server


def test_only_the_servers_own_names_are_answered(served: Served) -> None:
    port = served.address.split(":")[1]
    for host in (served.address, f"localhost:{port}", "LOCALHOST", "192.0.2.7", f"[::1]:{port}", "fleet.example.org"):
        assert served.ask("/api/fleet", headers={"Host": host}).status == 200, host
    hostile = ("evil.example.org", f"evil.example.org:{port}", "localhost.evil.org", "fleet.example.org.evil.org",
               "user@127.0.0.1", "127.0.0.1#evil", "127.0.0.1/", "[evil]", "", "1.2.3", "localhost:1:2")  # fmt: skip
    for host in hostile:
        for path in ("/", "/api/fleet", "/api/changes", "/fleet.csv"):
            answer = served.ask(path, headers={"Host": host})
            assert (answer.status, "sensors" in answer.text) == (400, False), (host, path)


def test_every_answer_forbids_other_origins_and_frames(served: Served) -> None:
    for path in ("/", "/page.js", "/api/fleet", "/fleet.csv", "/nothing", "/api/nothing"):
        headers = served.ask(path).headers
        assert headers["content-security-policy"].startswith("default-src 'self';")
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert "access-control-allow-origin" not in headers


def test_a_request_that_may_change_something_must_come_from_the_page_itself(served: Served) -> None:
    port = served.address.split(":")[1]
    for origin in ("http://evil.example.org", "null", "", f"http://localhost:{port}", "http://127.0.0.1:1",
                   f"http://{served.address}.evil.org", f"http://{served.address}@evil.org"):  # fmt: skip
        answer = served.ask("/api/fleet", "POST", headers={"Origin": origin} if origin else {})
        assert (answer.status, "another page" in answer.text) == (400, True), origin
    assert served.ask("/api/fleet", "POST", headers={"Origin": f"http://{served.address}"}).status == 405


def test_no_path_leads_out_of_the_page(served: Served, tmp_path: Path) -> None:
    assert served.ask("/page.js").status == 200
    (tmp_path / "secret").write_text("secret")
    ways = ("/../server.py", "/..%2fserver.py", "/%2e%2e/server.py", "/..%5cserver.py", "/page/../../server.py",
            "/./page.js", "//etc/passwd", "/%2fetc%2fpasswd", "/page.js%00", "/monitor.sqlite",
            "/server.py", "/..;/server.py", f"/{tmp_path}/secret")  # fmt: skip
    for way in ways:
        answer = served.ask(way)
        assert (answer.status, answer.text) == (404, "no such page") or answer.text == "Not Found", way


def test_invented_names_and_numbers_of_sensors_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "SENSORS_MAX", 3)
    monkeypatch.setattr(fleet_module, "GATEWAYS_MAX", 2)
    fleet = Fleet()

    def takes(site: str, gateway: str, sensor: str) -> bool:
        if admitted := fleet.admits(Address(site, gateway, sensor, "status")):
            fleet.take(site, gateway, sensor, "status", {"status": "VALID", "reason": "x" * 10_000, "t_utc_ns": 1})
        return admitted

    refused = ("<script>", "..", "a/b", "é", "a" * 64, "")
    assert not any(takes("site", "gw", name) or takes(name, "gw", "s") or takes("site", name, "s") for name in refused)
    assert fleet.left_out == 3 * len(refused)
    assert fleet.gateways({}) == []  # refused names have left nothing behind, except the gateways of valid names
    assert all(takes("site", "gw", f"s{k}") for k in (0, 1))
    assert takes("site", "gw2", "s0")
    assert not takes("site", "gw", "s2")
    assert takes("site", "gw", "s1")
    for k in range(100):
        fleet.take("site", "gw", "s0", "drift", {"parameter": f"S{k}", "verdict": "stepped", "reason": "", "change": 1})
        fleet.take("site", "gw", "s0", f"invented{k}", {"sequence": k})
        fleet.set_alive("site", f"invented{k}", True)
        fleet.set_gateway_status("site", "gw", b"[" * 100_000)
        fleet.set_gateway_status(
            "site", "gw", b'{"state": "running", "reasons": [], "t_utc_ns": 1' + b" " * 100_000 + b"}"
        )
    assert len(fleet.rows()) == 3
    assert set(fleet._newest["site", "gw", "s0"]) == {"status"}
    assert [row["gateway"] for row in fleet.gateways({})] == ["gw", "gw2"]
    assert {row["state"] for row in fleet.gateways({})} == {""}
    assert all(len(row["why"]) < 2 * fleet_module.TEXT_MAX for row in fleet.rows())


def test_with_a_list_of_keys_only_signed_results_are_shown(site: Site, tmp_path: Path) -> None:
    known = listed(tmp_path / "known.keys", KEY)
    good, forger = Gateway(site, tmp_path / "gw"), Gateway(site, tmp_path / "forger", OTHER, "gw2")
    try:
        with Served(site, tmp_path / "monitor", known) as served:

            def rows(what: str) -> list[tuple[str, object, str]]:
                told = served.ask("/api/fleet").json
                assert told["bus"]["verifies"]
                return [(row["gateway"], row.get("verified", row.get("refused")), row["why"]) for row in told[what]]

            good.send(1)
            forger.send(1)
            refusal = "1 results in its name were refused: no known key of this gateway signed them"
            wait_for(lambda: rows("gateways") == [("gw2", 1, refusal), ("gw", 0, "")])
            wait_for(lambda: rows("sensors") == [("gw", True, "")])
    finally:
        good.stop()
        forger.stop()


def test_without_a_list_results_are_shown_as_not_verified_whatever_they_claim(site: Site, tmp_path: Path) -> None:
    gateway = Gateway(site, tmp_path / "gw", None)
    claims = record(gateway.store.last_sequence() + 1, "calibration", signed_by="0123456789abcdef")
    try:
        with Served(site, tmp_path / "monitor") as served:
            gateway.store.commit([claims])
            gateway.publisher.publish(claims)
            wait_for(lambda: [row["verified"] for row in served.ask("/api/fleet").json["sensors"]] == [False])
            kept = served.ask("/api/history?site=site&gateway=gw&sensor=mems&what=calibration").json
            assert [result["signed_by"] for result in kept] == [""]
    finally:
        gateway.stop()


HOSTILE = "'\"><img src=x onerror=\"document.title='owned'\"><script>alert(1)</script>\u202e=cmd()"
KEPT = {"sensor", "status", "verdict", "parameter", "role", "run_id"}  # texts that a consumer checks


def made_hostile(value: object) -> object:
    """Every text in a result replaced, keys of free names too."""
    if isinstance(value, dict):
        return {(name if name.isidentifier() else HOSTILE): v if name in KEPT else made_hostile(v)
                for name, v in value.items()}  # fmt: skip
    if isinstance(value, list):
        return [made_hostile(each) for each in value]
    return HOSTILE if isinstance(value, str) else value


def results() -> list[tuple[str, Result]]:
    """One of each kind, with all texts that a result can have."""
    shared = SharedError(reference="r", serial_number="1", certificate_sha256="a", sensitivity=[1.0], unknowns=["u"],
                         kinds=["k"], stated=[0.0], u_stated=[1e-3], value=[0.0], own_derivative=[[1.0]],
                         derivative=[[0.0] * 12])  # fmt: skip
    made = structs.replace(calibration(1), references=["r"], shared_errors=[shared], identity="A 1")
    drift = DriftReport(run_id="r", sequence=4, sensor="mems", t_utc_ns=1, parameter="Sxx", verdict="stepped",
                        change=1.0, u_change=1.0, rate=0.0, u_rate=0.0, onset_utc_ns=1, statistic=1.0, threshold=1.0,
                        false_alarms_a_year=0.1, reason="r")  # fmt: skip
    estimate = Estimate(run_id="r", sequence=5, sensor="mems", t_utc_ns=1, reason="r", calibration=made)
    of_window = structs.replace(window(2, reason="r"), numbers={"a b": 1.0})
    each = (made, of_window, status(3, "HELD"), drift, estimate, clock(6))
    return [(result.what, result) for result in each]


def hostile_guide() -> Guide:
    """A guide whose texts are all hostile, and whose numbers are extreme."""
    text, u = HOSTILE[:63], Expanded(1e308, -1e-308)
    made = Guide(
        t_utc_ns=2**63 - 1, sensor=text, stage="measuring", wanted=u, expanded=u, outlook=[HOSTILE], prompt=HOSTILE,
        next=NextStop(10**6, text, HOSTILE, HOSTILE, u, 10**6), staying=Staying(text, -1e308, 1e308, 0.0, u),
        taken=[TakenStop(text, u)] * 2, warnings=[Warned(0, HOSTILE)],
        ending=Ending("valid", [HOSTILE], [[text] * 4], -1e308, [MadeFile(HOSTILE, text)]),
    )  # fmt: skip
    read = read_guide(msgspec.json.encode(made), b"", "site/gw", None)
    assert read == made
    return made


@needs_chromium
def test_no_text_of_the_bus_becomes_part_of_the_page(served: Served) -> None:
    for number, (what, result) in enumerate(results(), start=1):
        fields = made_hostile(msgspec.json.decode(msgspec.json.encode(result)))
        assert isinstance(fields, dict)
        assert HOSTILE in fields.values()
        address = Address("site", "gw", "mems", what)
        served.database.add([Received("", address, number, fields, None)])
        served.fleet.take("site", "gw", "mems", what, fields)
    told = {"state": HOSTILE, "reasons": [HOSTILE], "version": HOSTILE, "t_utc_ns": 1}
    served.fleet.set_gateway_status("site", "gw", msgspec.json.encode(told))
    served.fleet.set_alive("site", "gw", True)
    served.following.benches.take("site", "gw", hostile_guide())
    sensor = "site=site&gateway=gw&sensor=mems"
    with chromium() as browser:
        watched = Watched(browser, served.address)
        for view in ("", f"#{sensor}", "#view=events", "#view=bench", "#view=<img src=x>",
                     f"#view=bench&site={HOSTILE}&gateway={HOSTILE}", f"#site={HOSTILE}&gateway=g&sensor=s",
                     f"#filter={HOSTILE}&sort={HOSTILE}&from={HOSTILE}&to=1"):  # fmt: skip
            page = watched.open(view)
            page.wait_for_function("() => document.getElementById('summary').textContent.startsWith('Sensors: 1')")
            if view == f"#{sensor}":
                page.get_by_text("Devices and certificates").wait_for()
                assert page.locator("td, dd", has_text="document.title").count() >= 8
            if view == "#view=bench":
                page.get_by_role("heading", name="Files", exact=False).wait_for()
                for part in ("now", "stay", "warnings", "end", "tables"):
                    assert "document.title" in page.locator(f"#bench-{part}").inner_text(), part
            assert page.locator("img, main script, main iframe").count() == 0, view
            assert page.title().startswith("fieldcal: ")
            assert "\u202e" not in page.locator("main").inner_text()
            page.goto("about:blank")
        watched.close()
    table = served.ask(f"/sensor.csv?{sensor}&what=status").text
    assert not any(cell.startswith(("=", "+", "-", "@")) for row in csv.reader(table.splitlines()) for cell in row)
