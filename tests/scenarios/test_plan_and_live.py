"""A person puts sensors on the plan, and looks at the signal of one, in a real browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.zenoh_site import Site, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("argon2", reason="the extra monitor is not installed")
pytest.importorskip("axe_playwright_python", reason="axe is not installed")
from agent.monitor.users import set_user
from tests.scenarios.fleet_page import Streaming, axe_faults
from tests.unit.monitor_site import Served

pytestmark = needs_chromium
PASSWORD = "correct horse battery staple"
PICTURE = Path(__file__).parents[2] / "docs" / "images" / "report.png"
STATUSES = {"deck-1": "VALID", "deck-2": "HELD", "deck-3": "INVALID", "<b>4": "VALID"}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


def heard(served: Served) -> None:
    """Four sensors of one gateway, the name of one of which no gateway can have."""
    served.fleet.set_alive("site", "gw", True)
    for sensor, status in STATUSES.items():
        fields = {"status": status, "reason": f"{sensor} <img src=x>", "t_utc_ns": time.time_ns()}
        served.fleet.take("site", "gw", sensor, "status", fields)


def log_in(watched: Watched, name: str, view: str) -> Any:
    page = watched.open(view)
    page.get_by_label("Name", exact=True).fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Log in").click()
    return page


@pytest.mark.thorough
def test_a_person_puts_sensors_on_the_plan(site: Site, tmp_path: Path, browser: Any) -> None:
    users = tmp_path / "users"
    set_user(users, "anna", ("plan",), PASSWORD)
    set_user(users, "bob", (), PASSWORD)
    with Served(site, tmp_path / "monitor", users=users) as served:
        heard(served)
        watched = Watched(browser, served.address, viewport={"width": 1280, "height": 900})
        page = log_in(watched, "anna", "#view=plan")
        page.get_by_text("There is no plan yet.").wait_for()
        page.locator("#plan-file").set_input_files(
            files=[{"name": "a.svg", "mimeType": "image/png", "buffer": b"<svg/>"}]
        )
        page.get_by_text("not kept: not a PNG or JPEG picture").wait_for()
        page.locator("#plan-file").set_input_files(PICTURE)
        page.get_by_text("the picture is kept").wait_for()
        page.wait_for_function("() => document.querySelector('#plan img')?.naturalWidth > 0")
        page.get_by_role("button", name="Arrange sensors").click()
        box = page.locator("#plan img").bounding_box()
        for k, sensor in enumerate(("deck-1", "deck-2", "deck-3")):
            page.locator("#plan-sensor").select_option(f"site/gw/{sensor}")
            page.mouse.click(box["x"] + (0.2 + 0.2 * k) * box["width"], box["y"] + 0.5 * box["height"])
            page.get_by_text(f"site/gw/{sensor} is kept").wait_for()
        first, second = page.locator("#plan-picture .point").nth(0), page.locator("#plan-picture .point").nth(1)
        first.press("ArrowRight")
        page.get_by_text("site/gw/deck-1 is kept").wait_for()
        second.hover()
        page.mouse.down()
        page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.25 * box["height"], steps=3)
        page.mouse.up()
        page.get_by_text("site/gw/deck-2 is kept").wait_for()
        page.locator("#plan-picture .point").nth(2).press("Delete")
        page.get_by_text("site/gw/deck-3 is off the plan").wait_for()
        told = page.evaluate("async () => (await fetch('api/plan')).json()")["positions"]
        assert {name: np.round(at, 2).tolist() for name, at in told.items()} == {
            "site/gw/deck-1": [0.21, 0.5], "site/gw/deck-2": [0.4, 0.25],
        }  # fmt: skip
        assert page.locator("#plan-picture .point").evaluate_all("all => all.map((one) => one.className)") == [
            "point ok", "point warn",
        ]  # fmt: skip
        assert page.locator("#plan img").count() == 1  # texts of the bus are no elements
        assert axe_faults(page) == []
        page.get_by_role("button", name="Arrange sensors").click()
        page.locator("#plan-picture .point").first.press("Enter")
        page.wait_for_function("() => location.hash.includes('sensor=deck-1')")
        watched.close()
        reader = Watched(browser, served.address)
        page = log_in(reader, "bob", "#view=plan")
        page.locator("#plan-picture .point").nth(1).wait_for()
        assert not page.get_by_role("button", name="Arrange sensors").is_visible()
        reader.close()


@pytest.mark.thorough
def test_the_signal_is_shown_with_its_spectrum_and_ends_when_nobody_looks(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    gateway = Streaming(site, tmp_path / "gateway")
    try:
        with Served(site, tmp_path / "monitor") as served:
            watched = Watched(browser, served.address)
            page = watched.open("#view=live&site=site&gateway=gw&sensor=mems")
            page.get_by_text("Waiting for a block.").wait_for()
            gateway.show(page)
            page.get_by_text(
                "Corrected acceleration by calibration 103, 200 Hz. Means of the newest block: x"
            ).wait_for()
            assert page.locator("#live .uplot").count() == 3
            page.get_by_label("Spectrum in").select_option("amplitude")
            page.get_by_text("Power spectral density, (m/s²)/√Hz").wait_for()
            assert axe_faults(page) == []
            page.get_by_text("What is shown is of then.").wait_for()  # the gateway sends nothing more
            assert served.live.streams == 1
            page.get_by_role("button", name="Stop").click()
            wait_for(lambda: served.live.streams == 0)
            page.get_by_role("button", name="Show the signal").click()
            wait_for(lambda: served.live.streams == 1)
            page.get_by_role("link", name="Fleet").click()
            wait_for(lambda: served.live.streams == 0)
            watched.close()
    finally:
        gateway.close()
