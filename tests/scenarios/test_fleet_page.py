"""A person at the fleet page, in a real browser: what rises to the top, views that a link keeps, and commands."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from agent.cli.command import command
from agent.keys.files import SigningKey, write_new
from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.command_desk import ANNA
from tests.unit.zenoh_site import Site, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("argon2", reason="the extra monitor is not installed")
pytest.importorskip("axe_playwright_python", reason="axe is not installed")
from agent.fleet.simulated_sensor import BEGINS, Behaviour
from agent.monitor.settings import FloorPlan
from agent.monitor.users import set_user
from tests.scenarios.fleet_page import IMAGES, CommandedGateway, PageSite, ask, axe_faults, page_site
from tests.unit.monitor_site import Monitor, Served

pytestmark = needs_chromium
PASSWORD = "correct horse battery staple"
PICTURE = IMAGES / "report.png"
SILENT_S = 10.0
# What has risen is shown when it is asked for; a click by a script leaves the focus where it is.
ASKED_AND_FIRST = """name => {
    const asked = document.getElementById('new-cards');
    if (!asked.hidden) asked.click();
    return document.querySelector('#cards a')?.textContent === name;
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


def first_card(page: Any) -> str:
    return str(page.locator("#cards .card").first.inner_text())


def assert_the_five_questions_are_answered(shown: PageSite, page: Any) -> None:
    """Which, since when, how sure, why, what next, by what the fleet was made to do; on one screen."""
    page.get_by_label("Find a sensor").fill("")
    page.wait_for_function("() => document.querySelectorAll('#cards .card').length > 4")
    page.set_viewport_size({"width": 1440, "height": 900})
    page.wait_for_function("() => document.querySelectorAll('#cards .curve').length > 0")
    answers = {answer["who"]: answer for answer in ask(page)}
    assert len(answers) == 5
    assert all(re.search("Values .*(may|are|nobody)", answer["usable"]) for answer in answers.values()), answers
    page.set_viewport_size({"width": 1440, "height": 1800})

    def of(behaviour: Behaviour) -> tuple[dict[str, str], str]:
        """The card of the odd sensor, and the day on which it became so: of 30 rounds, ten days apart."""
        begun = date.today() - timedelta(days=10 * (29 - BEGINS[behaviour]))
        return answers[f"{shown.fleet.names_of(behaviour)[0]} / s0"], begun.strftime("%b %-d")

    stepped, since = of("stepped")
    assert stepped["kind"] == "held"
    assert since in stepped["say"]
    assert "Three explanations fit about equally: another reference drift along z" in stepped["more"]
    assert " other sensors with the same reference are steady: " in stepped["more"]
    assert "fieldcal command accept" in stepped["next"] or "Correct it" in stepped["next"]
    held, since = of("held")
    assert held["kind"] == "held"
    assert since in held["say"]
    assert "the window contradicts the calibration" in held["say"]
    assert "mount" in held["next"]


@pytest.mark.nightly
def test_a_drifting_sensor_rises_is_sorted_opened_and_zoomed(site: Site, tmp_path: Path, browser: Any) -> None:
    places = {f"simulated/gw000{k}/s0": (0.1 + 0.1 * k, 0.5) for k in range(8)}
    plan = FloorPlan(picture=PICTURE, positions=places)
    with page_site(site, tmp_path, plan=plan) as shown:
        stepped = f"{shown.fleet.names_of('stepped')[0]} / s0"
        shown.rounds(6)
        watched = Watched(browser, shown.served.address, viewport={"width": 1440, "height": 1800})
        page = watched.open()
        page.locator("#groups .row").first.wait_for()
        assert stepped not in first_card(page)
        page.get_by_label("Find a sensor").fill("gw")
        held = page.locator("#groups .row", has_text="s1").first.locator("a")
        held.focus()
        kept = held.element_handle()
        shown.rounds(1)  # its step is told now
        page.wait_for_function(ASKED_AND_FIRST, arg=stepped, timeout=60_000)  # how soon: `benchmarks.fleet_page`
        assert kept.evaluate("link => link.isConnected && link === document.activeElement")  # no row is rebuilt
        page.locator("#cards .card").first.filter(has_text="fell by 2.97 %").wait_for()  # 3 % in truth
        assert page.get_by_text("<img src=x onerror=alert(3)>").count() == 1  # text, not an element
        assert page.locator("img").count() == 0
        assert axe_faults(page) == []
        assert_the_five_questions_are_answered(shown, page)
        page.get_by_role("link", name="Plan").click()
        page.locator("#plan-picture img:visible").wait_for()
        tones = page.locator("#plan-picture .point").evaluate_all("all => all.map((one) => one.classList[1])")
        assert Counter(tones) == {"ok": 2, "warn": 5, "off": 1}  # no drift is told yet, nor a clone
        page.wait_for_function("() => document.querySelector('#plan img').naturalWidth > 0")
        assert axe_faults(page) == []
        page.get_by_role("link", name="Fleet").click()

        counts = page.locator("#counts button").evaluate_all("all => all.map((one) => one.textContent)")
        assert counts == ["16sensors", "9in order", "0drifting", "5held", "2not heard"]
        page.get_by_role("button", name="held").press("Enter")  # by the keyboard
        page.wait_for_function("() => document.querySelectorAll('#groups .row').length === 5")
        page.reload()  # the link keeps the filter
        page.locator("#groups .row").first.wait_for()
        assert page.locator("#groups .row").count() == 5
        with page.expect_download() as saved:
            page.get_by_role("button", name="PNG").first.click()
        assert saved.value.path().read_bytes().startswith(b"\x89PNG")

        page.locator("#cards a").first.click()
        page.locator("#matrix table").first.wait_for()
        assert "Szz fell by" in page.locator("#state").inner_text()
        assert page.locator("#main-plot .uplot").count() == 1
        assert "times since" in page.locator("#sensor-events").inner_text() or shown.made < 8
        plot = page.locator("#main-plot .u-over")
        box = plot.bounding_box()
        middle = box["y"] + box["height"] / 2
        page.mouse.move(box["x"] + 0.3 * box["width"], middle)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=3)
        page.mouse.up()
        page.wait_for_function("() => location.hash.includes('from=')")
        zoomed = page.evaluate("() => location.hash")
        page.reload()
        page.locator("#matrix table").first.wait_for()
        assert page.evaluate("() => location.hash") == zoomed
        assert page.locator("#span").input_value() == "zoom"
        page.locator("#main-plot").press("0")
        page.wait_for_function("() => !location.hash.includes('from=')")
        page.get_by_text("When to look again").click()
        page.get_by_text(re.compile(r"[SQ][xyz]+: 4 calibrations in 30 days")).wait_for()
        with page.expect_download() as saved:
            page.get_by_role("button", name="PNG").last.click()
        assert saved.value.path().read_bytes().startswith(b"\x89PNG")
        assert axe_faults(page) == []
        for width in (820, 390):
            page.set_viewport_size({"width": width, "height": 800})
            for view in ("", f"#{page.evaluate('() => location.hash')[1:]}"):
                watched.open(view).locator("main section:visible").first.wait_for()
                page.locator("#cards .card:visible, #matrix table:visible").first.wait_for()
                assert page.evaluate("() => document.documentElement.scrollWidth") <= width
                assert axe_faults(page) == []
        watched.open("#view=events").locator("#events:visible").wait_for()
        assert axe_faults(page) == []
        watched.open("parts.html").locator(".card").first.wait_for()
        assert axe_faults(page) == []
        watched.close()  # no request to outside, no error


def log_in(watched: Watched, name: str) -> Any:
    page = watched.open("#site=workshop&gateway=gateway-1&sensor=mems")
    page.get_by_label("Name", exact=True).fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Log in").click()
    page.get_by_role("button", name="Hold").wait_for()
    return page


def test_commands_with_and_without_the_right(site: Site, tmp_path: Path, browser: Any) -> None:
    users, key_file = tmp_path / "users.txt", tmp_path / "anna.command.key"
    write_new(tmp_path, {key_file.name: SigningKey("anna", ANNA).pem})
    set_user(users, "anna", ("accept", "rollback"), PASSWORD)
    set_user(users, "bob", (), PASSWORD)
    gateway = CommandedGateway(site, tmp_path / "gateway")
    try:
        with Served(site, tmp_path / "monitor", users=users) as served:
            wait_for(lambda: len(served.fleet.rows()) == 1)
            estimate = gateway.publish_more()
            anna = Watched(browser, served.address)
            page = anna.open()
            page.locator("#login:visible").wait_for()
            assert axe_faults(page) == []
            log_in(anna, "anna")
            page.get_by_role("heading", name="Response over frequency; S holds at 5 Hz").wait_for()
            for shown in ("9.0 – 27 Hz", "Q holds at 21 °C", "References: B12 4711", "25595 ± 40, imaginary 0"):
                assert shown in page.locator("#details").evaluate("all => all.textContent"), shown
            assert "26154\n± 12" in page.locator("#matrix").inner_text()  # never 26154 ± 12.000
            page.get_by_text("History of calibrations").click()
            page.get_by_role("heading", name="Estimates that are not in force").click()
            page.get_by_role("link", name="Live signal").click()
            page.get_by_text("waiting for a block").wait_for()
            while page.get_by_text("corrected acceleration by calibration 103, 200 Hz").count() == 0:
                gateway.stream()
                page.wait_for_timeout(100)
            page.get_by_role("link", name="workshop/gateway-1/mems").click()
            page.get_by_text("History of calibrations").click()
            page.get_by_role("heading", name="Estimates that are not in force").click()
            page.get_by_role("button", name="Roll back to 101").wait_for()

            def sent(button: str) -> str:
                page.get_by_role("button", name=button).first.click()
                arguments = page.locator("#order code").inner_text().replace("KEY", str(key_file)).split()
                assert arguments[:2] == ["fieldcal", "command"]
                page.get_by_label("signed line").fill(CliRunner().invoke(command, arguments[2:]).output)
                assert axe_faults(page) == []
                page.get_by_role("button", name="Send").click()
                told = page.locator("#told").filter(has_text=":").or_(page.locator("#told").filter(has_text="taken"))
                told.wait_for()
                text = str(told.inner_text())
                page.get_by_role("button", name="Close").click()
                return text

            assert '"verb":"rollback","arguments":{"sequence":101}' in sent("Roll back to 101")
            assert sent(f"Accept {estimate}").startswith("refused: key anna has no right to send accept")
            assert [(event.verb, bool(event.refused)) for event in gateway.desk.events] == [
                ("rollback", False), ("accept", True)]  # fmt: skip
            page.get_by_role("button", name="Hold").click()  # the user has no right to it: the line alone
            page.get_by_text("anna has no right to send hold from here").wait_for()
            assert axe_faults(page) == []
            line = "fieldcal command hold --sensor mems --gateway workshop/gateway-1 --key KEY --connect ENDPOINT"
            assert page.locator("#order code").inner_text() == line
            assert page.get_by_role("button", name="Send").count() == 0
            anna.close()

            bob = Watched(browser, served.address)
            page = log_in(bob, "bob")
            page.get_by_text("History of calibrations").click()
            page.get_by_role("button", name="Roll back to 101").click()
            page.get_by_text("bob has no right to send rollback from here").wait_for()
            assert page.get_by_role("button", name="Send").count() == 0
            page.get_by_role("button", name="Close").click()
            page.get_by_role("button", name="Log out").click()
            page.locator("#login:visible").wait_for()
            assert page.locator("#sensor:visible").count() == 0
            bob.close()
            assert len(gateway.desk.events) == 2
    finally:
        gateway.close()


@pytest.mark.thorough
def test_a_killed_gateway_is_shown_and_a_restarted_monitor_has_the_whole_history(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    options = ["simulate", "--fleet", "1", "--sensors", "1", "--every", "0.3", "--connect", site.endpoint]
    monitor = Monitor(site.endpoint, tmp_path / "monitor")
    gateway = subprocess.Popen([sys.executable, "-m", "agent", *options], stdout=subprocess.DEVNULL)
    asked = "api/history?site=simulated&gateway=gw0000&sensor=s0&what=calibration"
    try:
        watched = Watched(browser, monitor.address)
        page = watched.open()
        page.get_by_text(re.compile(r"1 sensor, (running|on the bus)")).wait_for()
        wait_for(lambda: len(monitor.get(asked)) > 3)
        gateway.kill()
        gateway.wait()
        begun = time.monotonic()
        page.get_by_role("button", name="1 not heard").wait_for()
        page.locator("#new-cards", has_text="1 new").click()
        page.locator("#cards", has_text="Not heard since").wait_for()
        assert page.locator("#gateways td").all_inner_texts()[:3] == ["simulated/gw0000", "no", ""]  # its state is old
        assert time.monotonic() - begun < SILENT_S
        history = monitor.get(asked)
        monitor.stop()
        page.get_by_text("the monitor does not answer since").wait_for()
        page.locator("main.old").wait_for()  # what is shown is old, and looks so
        monitor = Monitor(site.endpoint, tmp_path / "monitor", address=monitor.address)
        page.get_by_text("Sensors: 1; 1 not in order").wait_for()  # the open page goes on by itself
        page.locator("main:not(.old)").wait_for()
        assert monitor.get(asked) == history
        watched.close()
    finally:
        gateway.kill()
        gateway.wait()
        monitor.stop()
