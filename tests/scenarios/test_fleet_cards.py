"""What the page says of a sensor, for each kind of it; that nothing moves under the eyes of who reads; many tabs."""

from __future__ import annotations

import itertools
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.core.events import DriftReport, Result
from agent.delivery.keys import Address
from agent.delivery.received import Received
from calib.rounding import plus_minus
from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.results import calibration, status, window
from tests.unit.test_docs_commands import unknown
from tests.unit.zenoh_site import Site

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("axe_playwright_python", reason="axe is not installed")
from agent.monitor import server
from agent.monitor.settings import FloorPlan
from tests.scenarios.fleet_page import DAY_NS, IMAGES, axe_faults
from tests.unit.monitor_site import Monitor, Served

pytestmark = [needs_chromium, pytest.mark.thorough]
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
    # U is larger than the change: the test has found it, so its size is from 0 on.
    ("drifting", "Values of today may be used: U = ± 3.7 %",
     r"Sxx rises by 0.31 % \(0 to 0.79 %\) a month, 2.4 % \(0 to 6.1 %\) since .+ \(± 6 d\)\.$"),
    ("changed", r"Values of today may be used: .+S and Q follow the change\. Values of {39} to",
     r"fell by 3.10 % \(± 0.20 %\) at once, between {39} and {40}\."),
    ("held", r"Values since {47} may not be used: windows contradict S and Q in force.+Earlier ones may: U = ± 0.42 %",
     r"Held since .+: Sensitivity Syy fell by 9.00 % \(± 0.20 %\), and with it offset Qy rose by 0.9000 m/s² "
     r"\(± 0.0020 m/s²\), at once, between {47} and {49}\.$"),
    ("held", "Values since .+ may not be used: windows contradict", "Held since .+: the window contradicts"),
    ("held", "Values since .+ are not checked: an operator put the calibration on hold", "put on hold by anna"),
    ("two of one name", "Values may not be used: two gateways have this name", "their results are mixed"),
    ("no data", "Values until the last window that fitted .+ may be used: .+Later values may not be used",
     "No data since"),
    ("not heard", "Values until the last window that fitted .+ may be used: .+Of later values nobody knows",
     r"Not heard since .+, 35 d ago\. Its results came late: the newest one is of {50}, 45 d ago\."),
    ("retired", "Values until the last window that fitted .+ may be used", r"Not heard since .+, 45 d ago\.$"),
    ("suspected", r"Values of today may be used with a larger U: ± 2.3 %, which holds the suspected change\. S and Q "
     r"in force stay as they are\. Values before 2026-05-01 may be used with U as it was\.",
     r"Suspected: Sensitivity of x fell by 1.10 % \(± 0.30 %\) since 2026-05-03 \(between 2026-05-01 and "
     r"2026-05-05\)\."),
    ("not calibrated", "Values may not be used yet: no calibration is in force", "Windows are being collected"),
]  # fmt: skip
HERE, KEYED = "on gateway bridge/span-2:", "on a machine with your key (KEY: its file; ENDPOINT: the router):"
ORDER = "--sensor deck-03 --gateway bridge/span-2 --key KEY --connect ENDPOINT"
VISIT, DOCTOR = (f"fieldcal {words}" for words in (
    "visit gateway.toml --data-dir visit --sensor", "doctor /etc/fieldcal/gateway.toml --data-dir /var/lib/fieldcal"
))  # fmt: skip
# Of each of them: where to run a command, and the command.
RUN = [
    (HERE, f"{VISIT} deck-07"), (HERE, f"{VISIT} deck-08"), (HERE, f"{VISIT} deck-04"),
    *[(KEYED, f"fieldcal command accept --sequence 12 {ORDER}")] * 2,
    (KEYED, f"fieldcal command hold --release {ORDER}"), ("on the copy alone:", "sudo systemctl stop fieldcal"),
    (HERE, DOCTOR), (HERE, DOCTOR), None, (HERE, f"{VISIT} pier-2"),
    (HERE, "journalctl -fu fieldcal -o cat"),
]  # fmt: skip
RUN_OF = """all => all.map((c) => [...c.querySelectorAll('.command')].map((one) =>
    [one.previousElementSibling.textContent, one.querySelector('code').textContent]))"""
# What the page does not explain where it says it.
EXPLAINED_WORDS = ["S", "Q", "U, ±", "values", "in force", "window", "no verdict, adopted", "steady", "reference",
                   "valid band", "estimate, accept", "times", "visit, doctor", "signatures", "unconfirmed"]  # fmt: skip
NO_CLIPBOARD = "Object.defineProperty(Navigator.prototype, 'clipboard', { get: () => undefined });"  # as over http
HIDE = """() => {
    Object.defineProperty(document, 'hidden', { value: true, configurable: true });
    document.dispatchEvent(new Event('visibilitychange'));
}"""
SHOW = "() => { delete document.hidden; document.dispatchEvent(new Event('visibilitychange')); }"
# Of the table of all sensors: what a desk shows, what of it a narrower window does not, and the heads on a phone.
COLUMNS = {"name", "x", "y", "z", "change", "over", "u", "band", "good", "reference"}
BESIDE, CURVES = {"band", "reference"}, {"name", "x", "y", "z"}
SHOWN_COLUMNS = """row => [...document.querySelector(row).children]
    .filter((cell) => getComputedStyle(cell).display !== 'none').map((cell) => cell.dataset.column)"""
TABS = 8  # a browser has six connections to one server
CONTRADICT = "6 held windows contradict the state: chi-squared 5094, 141 at most if it is right. "
BY_REFERENCE = (
    CONTRADICT + "Best fits another reference drift (reference_drift_z +9.96 %): chi-squared 83. As well fits: another "
    "reference sensitivity (reference_z +9.95 %). Compare devices and mount with the configuration"
)
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
# What is said of a reason, and of what to do, with so many others of which so many have changed.
MORE_OF = """async ([reason, count, changed]) => {
    const { steps, told } = await import('./words.js'), { make } = await import('./common.js');
    const row = { kind: 'held', status: 'HELD', status_utc_ns: 1, reason, verdicts: [] }, trends = { beside: { count, changed } };
    return [make('p', told(row, trends).more).textContent, make('p', steps(row, trends)).textContent];
}"""  # noqa: E501
DAY = "k => new Date(Date.now() - (59 - k) * 432e6).toLocaleString('en-US', { day: 'numeric', month: 'short' })"
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


# What is said of a net change that the history does not show: its u is not known.
NET_CHANGE = """async () => {
    const { told } = await import('./words.js'), { make } = await import('./common.js'), ns = 1e6 * Date.now(), day = 86400e9;
    const verdict = { parameter: 'Syy', verdict: 'drifting', change: 260, u_change: null, rate: 2.6, u_rate: null,
        onset_utc_ns: ns - 100 * day, t_utc_ns: ns, first_utc_ns: ns, drifts: true, false_alarms_a_year: 0.1 };
    const row = { kind: 'drifting', status: 'VALID', status_utc_ns: ns, reason: '', verdicts: [verdict] };
    const { say, more } = told(row, { found: { Syy: { scale: 26000 } } });
    return make('p', [...say, ...more]).textContent;
}"""  # noqa: E501
RANGE = (
    "() => [...['from', 'to'].map((n) => Number(new URLSearchParams(location.hash.slice(1)).get(n))), location.hash]"
)
NUMBERS = itertools.count(1)  # of results of one gateway
# The boxes of names, of points and of the picture.
BOXES = """() => {
    const box = (one) => { const { left, top, right, bottom } = one.getBoundingClientRect(); return [left, top, right, bottom]; };
    const points = [...document.querySelectorAll('#plan-picture .point')], shown = points.filter((p) => p.firstChild.checkVisibility());
    return [Object.fromEntries(shown.map((p) => [p.textContent, box(p.firstChild)])), Object.fromEntries(points.map((p) => [p.textContent, box(p)])), box(document.querySelector('#plan img'))];
}"""  # noqa: E501


def meet(one: list[float], other: list[float]) -> bool:
    """Whether two boxes (left, top, right, bottom) have a part in common."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def outside(one: list[float], whole: list[float]) -> bool:
    """Whether a part of the box is outside of the other."""
    return one[0] < whole[0] or one[1] < whole[1] or one[2] > whole[2] or one[3] > whole[3]


def stepped(sequence: int, parameter: str) -> DriftReport:
    """A verdict that the parameter has stepped."""
    return DriftReport(run_id="r", sequence=sequence, sensor="mems", t_utc_ns=status(sequence).t_utc_ns,
                       parameter=parameter, verdict="stepped", change=-500.0, u_change=5.0, rate=0.0, u_rate=0.0,
                       onset_utc_ns=status(1).t_utc_ns, statistic=20.0, threshold=15.0, false_alarms_a_year=0.1,
                       reason="r")  # fmt: skip


def keep(served: Served, sensor: str, *results: Result) -> None:
    """Put results of a sensor of site/gw, which is on the bus, into database and fleet, with new numbers."""
    served.fleet.set_alive("site", "gw", True)
    for result in results:
        number = next(NUMBERS)
        fields = msgspec.json.decode(msgspec.json.encode(result)) | {"sensor": sensor, "sequence": number}
        served.database.add([Received("", Address("site", "gw", sensor, result.what), number, fields, None)])
        served.fleet.take("site", "gw", sensor, result.what, fields)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


ROUNDED = """async (values) => {
    const { plusMinus } = await import('./format.js');
    return values.map((one) => plusMinus(...one));
}"""


def test_the_page_rounds_as_every_other_text_does(site: Site, tmp_path: Path, browser: Any) -> None:
    sizes, U = (98765.4, 5.1, 0.012342), (1234.0, 99.6, 12.3, 0.0999, 4e-5)
    values = [(sign * size, expanded) for sign in (1.0, -1.0) for size in sizes for expanded in U]
    with Served(site, tmp_path / "monitor") as served:
        told = Watched(browser, served.address).open().evaluate(ROUNDED, values)
    assert told == [plus_minus(*one).replace("-", "\N{MINUS SIGN}") for one in values]


def test_each_kind_of_sensor_says_what_it_is_and_whether_its_values_may_be_used(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        # Dates are English as the words are, whatever the language of the browser.
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900}, locale="fa-IR")
        page = watched.open("parts.html")
        page.locator("#numbers table").wait_for()
        cards = page.locator("#cards .card").evaluate_all(
            "all => all.map((c) => ['.chip', '.may', '.say'].map((part) => c.querySelector(part).textContent))"
        )
        assert [kind for kind, _, _ in cards] == [kind for kind, _, _ in SAID]
        # A date is that of an invented calibration, of 60 each fifth day until today.
        days: dict[str | Any, Any] = {str(k): page.evaluate(DAY, k) for k in (39, 40, 47, 49, 50)}
        for (_, usable, say), (kind, wanted, part) in zip(cards, SAID, strict=True):
            assert re.match(re.sub(r"\{(\d+)\}", lambda k: days[k[1]], wanted), usable), (kind, usable)
            assert re.search(re.sub(r"\{(\d+)\}", lambda k: days[k[1]], part), say), (kind, say)
        for commands, wanted_run in zip(page.locator("#cards .card").evaluate_all(RUN_OF), RUN, strict=True):
            assert len(commands) == (wanted_run is not None)
            for where, command in commands:
                assert wanted_run is not None
                assert (where[-len(wanted_run[0]) :], command) == wanted_run
                program, *words = command.split()
                assert program != "fieldcal" or list(unknown(words)) == []
        unsure = page.locator("#cards .card").nth(1).locator(".more").inner_text()
        assert "How far it has changed is less sure: U of the change is ± 3.7 %." in unsure
        held_by_windows, on_hold = (page.locator("#cards .card").nth(k).locator(".more").inner_text() for k in (3, 5))
        witnesses = "16 of 17 other sensors with the same reference are steady"
        assert witnesses in held_by_windows
        assert witnesses not in on_hold
        for reason, wanted in EXPLAINED:
            assert wanted in page.evaluate(MORE_OF, [reason, 0, 0])[0]
        # A gateway cannot tell sensor from reference; the others with the same reference can.
        for changed, said, do in ((1, "But 8 of 9", "Look at the sensor"), (5, ". Only 4 of 9", "Compare devices")):
            more, todo = page.evaluate(MORE_OF, [BY_REFERENCE, 9, changed])
            assert said in more, more
            assert todo.startswith(do), todo
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
        said = page.evaluate(NET_CHANGE)
        assert re.match(r"Sensitivity Syy rises by 0.3044 % a month, 1 % since .*; told on ", said), said
        assert "±" not in said
        watched.close()


def test_a_change_that_is_not_in_force_is_said_so_and_each_word_is_explained(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        keep(served, "mems", calibration(1), status(2, "HELD"), stepped(3, "Sxx"), stepped(4, "Qx"))
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open("#site=site&gateway=gw&sensor=mems")
        cells = page.locator("#matrix td")
        cells.first.wait_for()
        assert [cells.nth(k).inner_text().split("\n")[2:] for k in (0, 1, 9, 10)] == [
            ["not in force"], ["moved 0.0 U"], ["not in force"], ["moved 0.0 U"],
        ]  # fmt: skip
        assert cells.evaluate_all("all => all.map((c) => c.className)")[:2] == ["moved", ""]
        page.get_by_role("button", name="Words").click()
        words = page.locator("#words dt")
        assert words.first.is_visible()
        chips = page.evaluate("async () => Object.values((await import('./parts.js')).KINDS).map(([word]) => word)")
        assert words.all_inner_texts() == [*EXPLAINED_WORDS, *chips]
        assert all(page.locator("#words dd").evaluate_all("all => all.map((d) => d.textContent.length > 20)"))
        for width in (1440, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.locator("#words").evaluate("w => w.scrollWidth <= w.clientWidth"), width
            assert axe_faults(page) == []
        watched.close()


def test_columns_by_the_width_of_the_window_and_windows_by_their_verdict(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    held, refused = window(2, used=False, reason="the window contradicts the calibration"), window(3, used=False)
    held.numbers["innovation_chi2"] = 900.0
    with Served(site, tmp_path / "monitor") as served:
        keep(served, "mems", window(1), held, refused, calibration(4), status(5))
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open()
        page.locator("#groups .row").wait_for()
        for width, heads, cells in (
            (1440, COLUMNS, COLUMNS), (820, COLUMNS - BESIDE, COLUMNS - BESIDE), (390, CURVES, COLUMNS - BESIDE),
        ):  # fmt: skip
            page.set_viewport_size({"width": width, "height": 900})
            assert set(page.evaluate(SHOWN_COLUMNS, "#heads")) == heads, width
            assert set(page.evaluate(SHOWN_COLUMNS, "#groups .row")) == cells, width
        watched.open("#site=site&gateway=gw&sensor=mems")
        rows = page.get_by_role("table", name="Windows", exact=True).locator("tr td:nth-child(3)")
        page.locator("summary", has_text="Windows").click()
        assert rows.all_inner_texts() == ["refused", "held", "used"]
        watched.close()


def test_the_plot_of_a_sensor_marks_what_happened(site: Site, tmp_path: Path, browser: Any) -> None:
    with Served(site, tmp_path / "monitor") as served:
        later = msgspec.structs.replace
        first = later(calibration(1), references=["B12 4711"])
        keep(
            served, "mems", first, status(1),
            later(first, t_utc_ns=first.t_utc_ns + DAY_NS, references=["B13 9"]),
            later(first, t_utc_ns=first.t_utc_ns + 2 * DAY_NS, references=["B13 9"], made_sequence=1),
            later(status(2, "RECALIBRATING", "5 windows agree"), before="HELD"),
            later(status(3, "VALID", "put on hold by anna"), before="RECALIBRATING"), stepped(4, "Sxx"),
        )  # fmt: skip
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open("#site=site&gateway=gw&sensor=mems")
        plot = page.locator("#main-plot .plot")
        page.locator("#main-plot .uplot").wait_for()
        told = str(plot.get_attribute("aria-label"))
        for mark in ("Sxx steps", "reference B13 9", "restart", "jump adopted", "operator"):
            assert told.count(mark) == 1, told
        page.locator("#main-plot").press("+")
        page.wait_for_function("() => location.hash.includes('from=')")
        for key, change in (("+", 0.5), ("ArrowRight", 1.0), ("-", 2.0)):
            before = page.evaluate(RANGE)
            page.locator("#main-plot").press(key)
            page.wait_for_function("before => location.hash !== before[2]", arg=before)
            after = page.evaluate(RANGE)
            assert after[1] - after[0] == pytest.approx(change * (before[1] - before[0]), abs=2), key
            assert (after[0] > before[0]) == (key != "-"), key
        watched.close()


def test_a_page_hears_its_monitor_while_nothing_changes(
    site: Site, tmp_path: Path, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "ALIVE_S", 0.5)
    with Served(site, tmp_path / "monitor") as served:
        watched = Watched(browser, served.address)
        page = watched.open()
        alive = "new EventSource('api/changes').addEventListener('alive', () => { heard += 1; })"
        page.evaluate(f"() => {{ window.heard = 0; {alive}; }}")
        page.wait_for_function("() => heard > 1")
        watched.close()


def test_a_page_whose_monitor_hangs_looks_old_and_goes_on_when_it_answers_again(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    """Neither an end nor an error of the connection tells it, as where a computer sleeps."""
    monitor = Monitor(site.endpoint, tmp_path / "monitor")
    watched = Watched(browser, monitor.address)
    watched.context.clock.install()
    page = watched.open()
    page.get_by_text("Sensors: 0").wait_for()
    page.clock.run_for(30_000)
    page.locator("main:not(.old)").wait_for()
    monitor.send(signal.SIGSTOP)
    page.clock.run_for(45_000)
    page.get_by_text("the monitor does not answer since").wait_for()
    page.locator("main.old").wait_for()
    monitor.send(signal.SIGCONT)
    page.clock.run_for(30_000)
    page.locator("main:not(.old)").wait_for()
    page.get_by_text("Sensors: 0").wait_for()
    watched.close()
    monitor.stop()


def test_names_on_the_plan_cover_no_other(site: Site, tmp_path: Path, browser: Any) -> None:
    """Twelve sensors in three rows, so near that not all names find a place beside their points."""
    places = {f"site/gw/deck-{k:02}": ((k % 4) / 3, 0.3 + 0.02 * (k // 4)) for k in range(12)}
    plan = FloorPlan(picture=IMAGES / "report.png", positions=places)
    with Served(site, tmp_path / "monitor", plan=plan) as served:
        for k in range(12):
            keep(served, f"deck-{k:02}", status(1, ("HELD", "INVALID", "VALID")[k % 3]))
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        page = watched.open("#view=plan")
        page.locator("#plan-picture .point").nth(11).wait_for()
        page.wait_for_function("() => document.querySelector('#plan img').naturalWidth > 0")
        for width, least in ((1440, 6), (820, 4)):
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_function("width => innerWidth === width", arg=width)
            page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            names, points, picture = page.evaluate(BOXES)
            assert len(names) >= least, width
            for k, (name, box) in enumerate(names.items()):
                assert not outside(box, picture), (width, name)
                others = [*points.values(), *list(names.values())[k + 1 :]]
                assert not any(meet(box, other) for other in others), (width, name)
        hidden = page.locator("#plan-picture .point.quiet").first
        hidden.hover()
        assert hidden.locator("span").is_visible()  # the others come when a person points at them
        watched.close()


def test_a_card_that_comes_or_goes_moves_nothing_until_it_is_asked_for(
    site: Site, tmp_path: Path, browser: Any
) -> None:
    with Served(site, tmp_path / "monitor") as served:
        for k in range(12):
            keep(served, f"s{k:02}", calibration(1), status(1, "HELD" if k in (4, 8) else "VALID"))
        keep(served, "s00", calibration(2, sxx=26254.0))
        watched = Watched(browser, served.address, viewport={"width": 1440, "height": 900})
        watched.context.add_init_script(SHIFTS)
        page = watched.open()
        names, asked = page.locator("#cards h3 a"), page.locator("#new-cards")
        page.locator("#cards svg").nth(1).wait_for()
        large = page.locator("#groups .row", has_text="s00")  # 100 counts, and U of the change is 17
        large.get_by_text("no verdict").wait_for()
        assert large.locator(".number").all_inner_texts()[:2] == ["+0.382 %", "5.9 U\nno verdict"]
        keep(served, "s02", status(2, "HELD"))
        keep(served, "s08", status(2, "VALID"))
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
        # A sensor that is opened by a link is seen from its top, and who goes back is where the link was.
        page.set_viewport_size({"width": 1440, "height": 500})
        link = page.locator("#groups .row").nth(9).locator("a")
        link.scroll_into_view_if_needed()
        before = page.evaluate("() => scrollY")
        link.click()
        page.locator("#matrix table").first.wait_for()
        assert (before > 500, page.evaluate("() => scrollY")) == (True, 0)
        page.go_back()
        page.locator("#groups .row").nth(9).wait_for()
        page.wait_for_function("before => scrollY === before", arg=before)
        for width in (1440, 1150, 1140, 1024, 820, 768, 721, 720, 600, 390, 320):
            page.set_viewport_size({"width": width, "height": 900})
            page.locator("#groups .row").first.wait_for()
            assert page.locator("#groups .row > *").evaluate_all(CUT) == [], width
            assert page.locator("#sensors .row").evaluate_all(CUT) == [], width
        watched.close()


@pytest.mark.nightly
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
            page.get_by_text("Sensors: 0").wait_for()
            if page is not pages[-1]:
                page.evaluate(HIDE)
        keep(served, "mems", calibration(1), status(2, "HELD"))
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
