"""How quick the fleet page is, in Chromium, with simulated sensors: `python -m benchmarks.fleet_page`.

Router, monitor and browser run on this machine; the monitor is a process of its own and has answered before. Each run
opens a new browser context: time from navigation to the first cards and rows painted, bytes until then and 2 s later
(as they come over the wire), time from a result on the bus to the page, tasks above 50 ms while the table is scrolled,
and layout shifts that no person's input caused: until the change, by the change (its card is told and comes in when it
is asked for, by a click), and while scrolling. The median of the runs counts; `--write` puts it into
docs/fleet-evidence.md.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from agent.fleet.simulated import NEVER, FleetPlan, SimulatedFleet, behaviours
from agent.fleet.simulated_sensor import BEGINS
from benchmarks.page import machine, write_part
from tests.unit.browser import chromium
from tests.unit.monitor_site import Monitor
from tests.unit.zenoh_site import Site, wait_for

GATEWAYS, SENSORS, SEED = 100, 10, 7
ROUNDS = 8  # of all gateways, 30 days apart; a drift is told then
HELD_FROM = BEGINS["held"]
DAY_NS = 86_400_000_000_000
SCROLLS, SCROLL_PX, APART_MS = 60, 240, 50
SETTLES_MS = 2000
WATCH = """
window.seen = { painted: 0, shifts: 0, tasks: [] };
new PerformanceObserver((l) => l.getEntries().forEach((e) => { if (!e.hadRecentInput) seen.shifts += e.value; }))
  .observe({ type: 'layout-shift', buffered: true });
new PerformanceObserver((l) => l.getEntries().forEach((e) => seen.tasks.push([e.startTime, e.duration])))
  .observe({ type: 'longtask', buffered: true });
const there = () => document.querySelector('#cards .card') && document.querySelector('#groups .row');
const look = () => (there() ? requestAnimationFrame(() => { seen.painted ||= performance.now(); })
  : requestAnimationFrame(look));
requestAnimationFrame(look);
"""


def run(browser: Any, monitor: Monitor, change: Any) -> dict[str, float]:
    """One run. `change` puts a result on the bus by which one sensor more is held."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    context.add_init_script(WATCH)
    page = context.new_page()
    received: list[float] = []
    network = context.new_cdp_session(page)
    network.send("Network.enable")
    network.on("Network.loadingFinished", lambda told: received.append(told["encodedDataLength"]))
    page.goto(f"{monitor.url}/")
    page.wait_for_function("() => seen.painted > 0")
    first = sum(received)
    page.wait_for_timeout(SETTLES_MS)
    unmoved = page.evaluate("() => seen.shifts")
    held = "() => [...document.querySelectorAll('#counts button')].map((b) => b.textContent).join()"
    before = page.evaluate(held)
    begun = time.monotonic()
    change()
    page.wait_for_function(f"before => ({held})() !== before", arg=before)
    seen_s = time.monotonic() - begun
    page.wait_for_timeout(SETTLES_MS)
    announced = page.locator("#new-cards").is_visible()  # where the card is one of the five worst
    if announced:
        page.locator("#new-cards").click()
        page.wait_for_timeout(SETTLES_MS)
    from_ms, moved = page.evaluate("() => [performance.now(), seen.shifts]")
    page.mouse.move(700, 600)
    for _ in range(SCROLLS):
        page.mouse.wheel(0, SCROLL_PX)
        page.wait_for_timeout(APART_MS)
    told = page.evaluate("() => seen")
    tasks = [duration for begin, duration in told["tasks"] if begin >= from_ms]
    found = {
        "painted after, s": told["painted"] / 1e3, "bytes until then, kB": first / 1e3,
        "bytes 2 s later, kB": sum(received) / 1e3, "a change is seen after, s": seen_s,
        "longest task while scrolling, ms": max(tasks, default=0.0),
        "layout shifts until then": unmoved, "by a change, and by its card": moved - unmoved,
        "cards that were announced": float(announced),
        "while scrolling": told["shifts"] - moved,
        "rows drawn after scrolling": page.locator("#groups .row").count(),
    }  # fmt: skip
    context.close()
    return found


def make(fleet: SimulatedFleet, rounds: int, monitor: Monitor, sensors: int) -> None:
    """Rounds of results, 30 days apart. `sensors`: that the page then has."""
    for k in range(rounds):
        fleet.step(time.time_ns() - (rounds - k) * 30 * DAY_NS)
        wait_for(lambda: len(monitor.sensors()) >= sensors, 300.0)
        print(f"{sensors} sensors, round {k + 1} of {rounds}", file=sys.stderr)


def main() -> None:
    """Measure, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="put the table into docs/fleet-evidence.md")
    args = parser.parse_args()
    site = Site()
    kinds = behaviours(GATEWAYS, SEED)
    # One gateway for each run has made all but the round in which its first sensor is held.
    late = [k for k, kind in enumerate(kinds) if kind in ("held", "leaning")][: args.runs]
    others = [k for k in range(GATEWAYS) if k not in late]
    with tempfile.TemporaryDirectory() as directory, chromium() as browser:
        monitor, data = Monitor(site.endpoint, Path(directory) / "monitor"), Path(directory) / "fleet"
        with (
            SimulatedFleet(FleetPlan(GATEWAYS, SENSORS, SEED, [site.endpoint], data), others) as fleet,
            SimulatedFleet(FleetPlan(GATEWAYS, SENSORS, SEED, [site.endpoint], data), late) as to_be_held,
        ):
            make(fleet, ROUNDS, monitor, len(others) * SENSORS)
            make(to_be_held, HELD_FROM, monitor, GATEWAYS * SENSORS)
            runs = [
                run(browser, monitor, lambda g=gateway: g.step(time.time_ns(), NEVER))
                for gateway in to_be_held.gateways
            ]
            tell(runs, write=args.write)  # before 100 gateways leave the bus, which takes a while
        monitor.stop()
    site.kill()


def tell(runs: list[dict[str, float]], *, write: bool) -> None:
    """Print the table, and write it into the document."""
    lines = [f"{GATEWAYS * SENSORS} sensors of {GATEWAYS} gateways, {len(runs)} runs; {machine()}.", "",
             "| | median | runs |", "| --- | --- | --- |"]  # fmt: skip
    for name in runs[0]:
        values = [each[name] for each in runs]
        lines.append(f"| {name} | {statistics.median(values):.3g} | {', '.join(f'{v:.3g}' for v in values)} |")
    print("\n".join(lines), flush=True)
    if write:
        write_part("fleet page", "\n".join(lines))


if __name__ == "__main__":
    main()
