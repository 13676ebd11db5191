"""What the page says of a sensor, for each kind of it; that nothing moves under the eyes of who reads; many tabs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.core.events import Result
from agent.delivery.keys import Address
from agent.delivery.received import Received
from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.results import calibration, status
from tests.unit.zenoh_site import Site

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from tests.unit.monitor_site import Served

pytestmark = needs_chromium
SHIFTS = """
window.moved = 0;
new PerformanceObserver((l) => l.getEntries().forEach((e) => { if (!e.hadRecentInput) moved += e.value; }))
  .observe({ type: 'layout-shift', buffered: true });
"""
# Of each invented sensor of parts.html: its chip, whether values may be used, and a part of what is said of it.
SAID = [
    ("drifting", r"Values of today may be used: U = ± 0.42 % \(Sxx\) at 1.0 – 18 Hz; S and Q follow the change\. "
     r"Values of .+ to .+, before they did, may be wrong by it\.",
     r"Sxx rises by .+ a month, 2.40 % \(± 0.50 %\) since"),
    ("drifting", "Values of today may be used: U = ± 3.7 %", r"since .+\. It is sure that it does, but not by how much"
     r": 2.4 % \(± 3.7 %\) so far"),
    ("changed", r"Values of today may be used: .+S and Q follow the change\. Values of {39} to",
     r"fell by 3.10 % \(± 0.20 %\) at once, between {39} and {40}\."),
    ("held", r"Values since {47} may not be used: windows contradict S and Q in force.+Earlier ones may: U = ± 0.42 %",
     r"Held since .+: Sensitivity Syy fell by 9.00 % \(± 0.20 %\) at once, between {47} and {49}\."),
    ("held", "Values since .+ may not be used: windows contradict", "Held since .+: the window contradicts"),
    ("held", "Values since .+ are not checked: an operator put the calibration on hold", "put on hold by anna"),
    ("two of one name", "Values may not be used: two gateways have this name", "their results are mixed"),
    ("no data", "Values until the last window that fitted .+ may be used: .+Later values may not be used",
     "No data since"),
    ("not heard", "Values until the last window that fitted .+ may be used: .+Of later values nobody knows",
     "Not heard since .+; its newest result is of"),
    ("suspected", r"Values of today may be used with a larger U: ± 2.3 %, which holds the suspected change\. S and Q "
     r"in force stay as they are\. Values before 2026-05-01 may be used with U as it was\.",
     r"Suspected: Sensitivity of x fell by 1.10 % \(± 0.30 %\) since 2026-05-03 \(between 2026-05-01 and "
     r"2026-05-05\)\."),
    ("not calibrated", "Values may not be used yet: no calibration is in force", "Windows are being collected"),
]  # fmt: skip
NO_CLIPBOARD = "Object.defineProperty(Navigator.prototype, 'clipboard', { get: () => undefined });"  # as over http
HIDE = """() => {
    Object.defineProperty(document, 'hidden', { value: true, configurable: true });
    document.dispatchEvent(new Event('visibilitychange'));
}"""
SHOW = "() => { delete document.hidden; document.dispatchEvent(new Event('visibilitychange')); }"
TABS = 8  # a browser has six connections to one server
CONTRADICT = "6 held windows contradict the state: chi-squared 5094, 141 at most if it is right. "
# What is said of windows that stay held, and how the page says it.
EXPLAINED = [
    (CONTRADICT + "Nearest, though not within what chance allows, is another reference drift (reference_drift_z +9.96 "
     "%): chi-squared 383. As well fits: another reference sensitivity (reference_z +9.95 %); another sensitivity (Szz "
     "-9.02 %). Compare devices and mount with the configuration",
     "Three explanations fit about equally: another reference drift along z (+9.96 %); another reference sensitivity "
     "along z (+9.95 %); another sensitivity Szz (\u22129.02 %); none fits within chance (chi-squared 383, limit 141)"),
    (CONTRADICT + "Best fits another offset (Qx -1.02 m/s2): chi-squared 120. Compare devices",
     "Explained best by another offset Qx (\u22121.02 m/s²) (chi-squared 120, limit 141)."),
    (CONTRADICT + "Best fits another filter of the sensor (S is larger there): chi-squared 120. Compare devices",
     "Explained best by another filter of the sensor (S is larger there) (chi-squared 120, limit 141)."),
    (CONTRADICT + "No known explanation fits them better. Compare devices", "No known explanation fits them better."),
]  # fmt: skip
MORE_OF = """async (reason) => {
    const { told } = await import('./words.js'), { make } = await import('./common.js');
    const row = { kind: 'held', status: 'HELD', status_utc_ns: 1, reason, verdicts: [] };
    return make('p', told(row, {}).more).textContent;
}"""
DAY = "k => new Date(Date.now() - (59 - k) * 432e6).toLocaleString(undefined, { day: 'numeric', month: 'short' })"
ROWS_OF = """async (words) => (await import('./plots.js')).rowsOf(words.map(([from, to]) => ({ from, to })))"""
CUT = "all => all.filter((c) => c.scrollWidth > c.clientWidth).map((c) => c.textContent)"
# What changes a row of parts.html, and whether its values may be used then.
CHANGED = [
    ({"u_axis": "Syy"}, "Values of today may be used: U = ± 0.42 % (Syy) at 1.0 – 18 Hz."),
    ({"u_pct": None, "band_hz": []}, "Values of today may be used: U is not known."),
    ({"calibration_utc_ns": -3}, "Values of today may be used: U = ± 0.42 % at 1.0 – 18 Hz (of "),
    # The policy `propose` publishes verdicts, and S and Q in force wait for an operator.
    ({"kind": "drifting", "verdicts": [-9, -2], "calibration_utc_ns": -3}, "may not be used: S and Q in force are of "),
    (
        {"kind": "drifting", "verdicts": [-9, -2], "status": "HELD", "status_utc_ns": -1},
        "may not be used: windows contr",
    ),
    ({"kind": "silent", "status": "HELD", "last_good_utc_ns": None}, "Of later values nobody knows."),
    ({"calibration_utc_ns": None}, "Values may not be used yet"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


def test_each_kind_of_sensor_says_what_it_is_and_whether_its_values_may_be_used(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open("parts.html")
        page.locator("#numbers table").wait_for()
        cards = page.locator("#cards .card").evaluate_all(
            "all => all.map((c) => ['.chip', '.may', '.say'].map((part) => c.querySelector(part).textContent))"
        )
        assert [kind for kind, _, _ in cards] == [kind for kind, _, _ in SAID]
        # A date is that of an invented calibration, of 60 each fifth day until today.
        days = {str(k): page.evaluate(DAY, k) for k in (39, 40, 47, 49)}
        for (_, usable, say), (kind, wanted, part) in zip(cards, SAID, strict=True):
            assert re.match(re.sub(r"\{(\d+)\}", lambda k: days[k[1]], wanted), usable), (kind, usable)
            assert re.search(re.sub(r"\{(\d+)\}", lambda k: days[k[1]], part), say), (kind, say)
        held_by_windows, on_hold = (page.locator("#cards .card").nth(k).locator(".more").inner_text() for k in (3, 5))
        witnesses = "16 of 17 other sensors with the same reference are steady"
        assert witnesses in held_by_windows
        assert witnesses not in on_hold
        for reason, wanted in EXPLAINED:
            assert wanted in page.evaluate(MORE_OF, reason)
        assert page.evaluate(ROWS_OF, [[0, 90], [50, 120], [60, 100], [70, 80], [91, 140]]) == [0, 1, 2, None, 0]
        assert "no more than the agent's test lets a sound sensor walk" in page.locator("#sound .more").inner_text()
        # The history goes on to today: the newest estimates dashed, and the windows that are held.
        held = page.locator("#cards .card").nth(3)
        assert (held.locator(".curve.dashed").count(), held.locator(".refused").count()) == (1, 11)
        for curve in page.locator("#cards .card .curve.y").evaluate_all(
            "all => all.map((c) => c.getAttribute('points'))"
        ):
            assert float(curve.split()[-1].split(",")[0]) in (100.0, pytest.approx(80, abs=3))  # not of what is lost
        assert page.locator(".command code").evaluate_all(CUT) == []
        for change, wanted in CHANGED:
            said = page.evaluate(
                """async (change) => {
                    const { covered } = await import('./words.js'), { make } = await import('./common.js'), ns = 1e6 * Date.now(), day = 86400e9;
                    const at = (v) => (typeof v === 'number' && v < 0 ? ns + v * day : v), of = Object.entries(change).map(([k, v]) => [k, at(v)]);
                    const row = { kind: 'sound', status: 'VALID', status_utc_ns: ns, reason: '', verdicts: [], u_pct: 0.42, band_hz: [1, 18], calibration_utc_ns: ns, last_good_utc_ns: ns, ...Object.fromEntries(of) };
                    if (row.verdicts.length) row.verdicts = [{ parameter: 'Sxx', onset_utc_ns: at(row.verdicts[0]), first_utc_ns: at(row.verdicts[1]) }];
                    return make('p', covered(row, {})[1]).textContent;
                }""",  # noqa: E501
                change,
            )
            assert wanted in said, (change, said)
        watched.close()


def test_a_card_that_comes_or_goes_moves_nothing_until_it_is_asked_for(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        number = 0

        def take(sensor: str, result: Result) -> None:
            nonlocal number
            number += 1
            fields = msgspec.json.decode(msgspec.json.encode(result)) | {"sensor": sensor, "sequence": number}
            served.database.add([Received("", Address("site", "gw", sensor, result.what), number, fields, None)])
            served.fleet.take("site", "gw", sensor, result.what, fields)

        served.fleet.set_alive("site", "gw", True)
        for k in range(12):
            take(f"s{k:02}", calibration(1))
            take(f"s{k:02}", status(1, "HELD" if k in (4, 8) else "VALID"))
        take("s00", calibration(2, sxx=26254.0))
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        watched.context.add_init_script(SHIFTS)
        page = watched.open()
        names, asked = page.locator("#cards h3 a"), page.locator("#new-cards")
        page.locator("#cards svg").nth(1).wait_for()
        large = page.locator("#groups .row", has_text="s00")  # 100 counts, and U of the change is 17
        large.get_by_text("no verdict").wait_for()
        assert large.locator(".number").all_inner_texts()[:2] == ["+0.382 %", "5.9 U\nno verdict"]
        take("s02", status(2, "HELD"))
        take("s08", status(2, "VALID"))
        asked.filter(has_text="1 new, 1 over: show").wait_for()
        page.get_by_text("Needs a person: 2").wait_for()
        assert names.all_inner_texts() == ["gw / s04", "gw / s08"]
        assert page.locator("#cards .chip").all_inner_texts() == ["held", "over"]
        assert page.evaluate("() => moved") == 0
        asked.click()
        assert names.all_inner_texts() == ["gw / s02", "gw / s04"]
        asked.wait_for(state="hidden")
        assert page.evaluate("() => moved") == 0  # what moves by a person's own click is not counted
        assert page.locator("#needs-count").inner_text() == "Needs a person: 2 things, 2 sensors"
        for width in (1440, 820, 390):
            page.set_viewport_size({"width": width, "height": 900})
            page.locator("#groups .row").first.wait_for()
            assert page.locator("#groups .row > *").evaluate_all(CUT) == [], width
        watched.close()


def test_more_tabs_than_a_browser_has_connections_and_a_copied_line_without_https(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        watched = Watched(browser, served.address)
        watched.context.add_init_script(NO_CLIPBOARD)
        first = watched.open()
        pages = [first, *(watched.context.new_page() for _ in range(TABS - 1))]
        for page in pages:
            page.goto(f"http://{served.address}/")
            page.get_by_text("Sensors: 0").wait_for(timeout=5000)
            if page is not pages[-1]:
                page.evaluate(HIDE)
        served.fleet.set_alive("site", "gw", True)
        for number, result in enumerate((calibration(1), status(2, "HELD")), start=1):
            fields = msgspec.json.decode(msgspec.json.encode(result)) | {"sequence": number}
            served.fleet.take("site", "gw", "mems", result.what, fields)
        pages[-1].get_by_text("Sensors: 1").wait_for()
        assert first.get_by_text("Sensors: 0").count() == 1  # nobody sees it
        first.evaluate(SHOW)
        first.get_by_text("Sensors: 1").wait_for()
        first.get_by_text("Held since").wait_for()  # who comes back sees the cards of now
        first.locator("#cards button").click()
        first.locator("#cards [role=status]").filter(has_text="cop").wait_for()
        line = first.locator("#cards code").inner_text()
        assert first.evaluate("() => getSelection().toString()") == line
        watched.close()
