"""A fleet on the bus, the page in a browser, and the pictures of the documentation.

`python -m tests.scenarios.fleet_page` writes docs/images/fleet*.png. With `--views DIR` it looks at fleet, sensor, plan
and live at three widths, light and dark: it writes a picture of each of the 24, and says what axe-core finds there and
what is wider than the window. The exit status is 1 where there is something.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh

from agent.commanding.network import serve_queries
from agent.core.events import Acceleration, Estimate
from agent.delivery.history import StoredResult
from agent.delivery.keys import gateway_key
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.fleet.simulated import FleetPlan, SimulatedFleet, behaviours
from agent.fleet.simulated_sensor import Behaviour
from agent.monitor.settings import FloorPlan
from agent.recording.acceleration import encode_acceleration
from tests.unit.browser import Watched, chromium
from tests.unit.command_desk import GATEWAY, DeskSite
from tests.unit.monitor_site import Served
from tests.unit.results import calibration
from tests.unit.zenoh_site import Site, record, wait_for

if TYPE_CHECKING:
    from PIL import Image

DAY_NS = 86_400_000_000_000
SEED = 7
# Sensitivities that fall with frequency, as the field `response` of a calibration.
RESPONSE = [
    {"low_hz": low, "high_hz": 3 * low, "sensitivity_re": np.diag([26000.0 - 5.0 * low**2] * 3).tolist(),
     "sensitivity_im": np.zeros((3, 3)).tolist(), "standard_uncertainty": np.full((3, 3), 20.0).tolist()}
    for low in (1.0, 3.0, 9.0)
]  # fmt: skip
DESK, TABLET, PHONE = ({"width": width, "height": 900} for width in (1440, 820, 390))
VIEWS: dict[str, tuple[dict[str, int], str]] = {
    "fleet": (DESK, "light"), "fleet-dark": (DESK, "dark"), "fleet-tablet": (TABLET, "light"),
    "fleet-phone": (PHONE, "light"), "fleet-readme": ({"width": 1100, "height": 620}, "light"),
}  # fmt: skip
COLOURS = 128  # of a picture, the most frequent ones, and as many between the others; more make the file larger
SETTLES_MS = 500  # of drawing
RATE_HZ = 200.0  # of a corrected stream
IMAGES = Path(__file__).parents[2] / "docs" / "images"


@dataclass
class PageSite:
    """A simulated fleet and the page of it. `made`: rounds that the fleet has made, ten days apart."""

    served: Served
    fleet: SimulatedFleet
    sensors: int
    made: int = 0

    def rounds(self, count: int, every_days: float = 10.0) -> None:
        """Let the fleet make so many rounds of results, the last of all 30 being of today."""
        for _ in range(count):
            # Of a gateway that the monitor meets for the first time it takes the newest results alone.
            wait_for(lambda: not self.made or len(self.served.fleet.rows()) == self.sensors)
            self.fleet.step(time.time_ns() - round((29 - self.made) * every_days * DAY_NS))
            self.made += 1


@contextmanager
def page_site(
    site: Site, directory: Path, gateways: int = 8, without: tuple[Behaviour, ...] = (), **options: Any
) -> Iterator[PageSite]:
    """Gateways with two sensors each, eight of which are odd, but those that behave as in `without`."""
    numbers = [k for k, behaviour in enumerate(behaviours(gateways, SEED)) if behaviour not in without]
    with (
        Served(site, directory / "monitor", **options) as served,
        SimulatedFleet(FleetPlan(gateways, 2, SEED, [site.endpoint], directory / "fleet"), numbers) as fleet,
    ):
        yield PageSite(served, fleet, 2 * len(numbers))


class CommandedGateway:
    """A gateway with one sensor and a calibration, that takes anna's commands."""

    def __init__(self, site: Site, directory: Path) -> None:
        directory.mkdir()
        self.desk = DeskSite(directory)
        self._store = Store(directory)
        place = gateway_key(*GATEWAY.split("/"))

        def serve(session: zenoh.Session, opened: ExitStack) -> None:
            serve_queries(session, place, self.desk.desk, opened)

        name, gateway = GATEWAY.split("/")
        self._publisher = Publisher(name, gateway, [site.endpoint], self._store, serve=serve)
        self._publisher.start()

    def publish_more(self) -> int:
        """A second calibration with all that the page can show, and an estimate, whose number this returns."""
        first = self._store.last_sequence() + 1
        estimate = Estimate(run_id="r", sequence=first + 1, sensor="mems", t_utc_ns=time.time_ns(),
                            reason="Sxx changed by 4 U", calibration=calibration(first + 1))  # fmt: skip
        known: dict[str, Any] = {
                 "response": RESPONSE, "reference_frequency_hz": 5.0, "reference_temperature_degc": 21.0,
                 "temperature_low_degc": 15.0, "temperature_high_degc": 30.0, "references": ["B12 4711"]}  # fmt: skip
        self.publish([record(first, "calibration", **known),
                      StoredResult.of(estimate, recorded=True, recording="f.mcap", epoch=""),
                      record(first + 2, "clock")])  # fmt: skip
        return first + 1

    def publish(self, records: Sequence[StoredResult]) -> None:
        """Keep results and publish them."""
        self._store.commit(records)
        for each in records:
            self._publisher.publish(each)

    def stream(self) -> None:
        """Publish half a second of the corrected stream."""
        wave = np.sin(np.arange(100) / 5.0)[:, None] * [1.0, 0.5, 0.0]
        block = Acceleration(
            sensor="mems", t_utc_ns=time.time_ns(), first_index=0, rate_hz=200.0, acceleration=wave,
            covariance=np.eye(3), noise=np.ones(3), determined=np.ones(12, dtype=bool), calibration_run_id="r",
            calibration_sequence=103, dynamic_only=False, recorded=True,
            suspect=np.zeros(3, dtype=bool),
        )  # fmt: skip
        self._publisher.stream("mems", encode_acceleration(1, block))

    def close(self) -> None:
        """Leave the bus."""
        self._publisher.close()
        self._store.close()


def ask(page: Any) -> list[dict[str, str]]:
    """What one screen says of the five worst: which (`who`, `kind`), since when, how sure and why (`say`, `more`),
    whether values may be used (`usable`), and what next (`next`). Only what a person sees without scrolling."""
    found: list[dict[str, str]] = page.evaluate(
        """() => [...document.querySelectorAll('#cards .card')].filter((card) => {
            const { top, bottom } = card.getBoundingClientRect();
            return top >= 0 && bottom <= innerHeight;
        }).map((card) => ({ who: card.querySelector('h3 a')?.textContent ?? card.querySelector('h3').textContent,
            kind: card.querySelector('.chip').textContent, say: card.querySelector('.say').textContent,
            usable: card.querySelector('.may').textContent,
            more: card.querySelector('.more').textContent, next: card.querySelector('.do').textContent }))"""
    )
    return found


class Streaming:
    """A gateway that publishes the corrected stream of `mems`: a tone along x and noise along y."""

    def __init__(self, site: Site, directory: Path, tone_hz: float = 12.5) -> None:
        directory.mkdir()
        self._store = Store(directory)
        self._publisher = Publisher("site", "gw", [site.endpoint], self._store)
        self._publisher.start()
        wait_for(lambda: self._publisher.state().connected)
        self._random, self._index, self._tone_hz = np.random.default_rng(1), 0, tone_hz

    def block(self, seconds: float) -> None:
        """The next samples, of so many seconds."""
        count = round(seconds * RATE_HZ)
        t = (self._index + np.arange(count)) / RATE_HZ
        noise = 0.05 * self._random.standard_normal(count)
        values = np.column_stack([np.sin(2 * np.pi * self._tone_hz * t), noise, 9.8 + 0 * t])
        block = Acceleration(
            sensor="mems", t_utc_ns=time.time_ns(), first_index=self._index, rate_hz=RATE_HZ, acceleration=values,
            covariance=np.eye(3), noise=np.ones(3), determined=np.ones(12, dtype=bool), calibration_run_id="r",
            calibration_sequence=103, dynamic_only=False, recorded=False,
            suspect=np.zeros(3, dtype=bool),
        )  # fmt: skip
        self._index += count
        self._publisher.stream("mems", encode_acceleration(1, block))

    def show(self, page: Any) -> None:
        """Publish until the page has the spectrum of a half minute."""
        while page.get_by_text("Corrected acceleration by calibration").count() == 0:  # until the monitor listens
            self.block(0.5)
            page.wait_for_timeout(100)
        for _ in range(2):
            self.block(15.0)
            page.wait_for_timeout(300)
        page.get_by_text("Resolution 0.15 Hz").wait_for()

    def close(self) -> None:
        """Leave the bus."""
        self._publisher.close()
        self._store.close()


def axe_faults(page: Any) -> list[str]:
    """What axe-core finds in the page."""
    from axe_playwright_python.sync_playwright import Axe

    return [f"{v['id']}: {v['nodes'][0]['html']:.200}" for v in Axe().run(page).response["violations"]]


def write_pictures() -> None:
    """The page with a fleet of 300 days: the fleet at three widths and dark, a sensor on a desk.

    Without the gateways that send hostile texts, or have copied cards.
    """
    site = Site()
    with (
        tempfile.TemporaryDirectory() as directory,
        page_site(site, Path(directory), 12, ("hostile", "cloned")) as shown,
        chromium() as browser,
    ):
        shown.rounds(30)
        for name, (viewport, scheme) in VIEWS.items():
            watched = Watched(browser, shown.served.address, viewport=viewport, color_scheme=scheme)
            page = watched.open()
            page.locator("#cards svg").first.wait_for()
            photograph(page, IMAGES / f"{name}.png")
            if name == "fleet":
                page.locator("#cards a").first.click()
                page.locator("#matrix table").first.wait_for()
                photograph(page, IMAGES / "fleet-sensor.png")
            watched.close()
    site.kill()


def photograph(page: Any, path: Path) -> None:
    """What the window shows, as a small file."""
    from PIL import Image

    page.wait_for_timeout(SETTLES_MS)
    page.screenshot(path=path)
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    with_few_colours(picture).save(path, optimize=True)


def with_few_colours(picture: Image.Image) -> Image.Image:
    """The picture with its COLOURS most frequent colours, and as many between the others."""
    from PIL import Image

    counts = sorted(picture.getcolors(picture.width * picture.height) or (), reverse=True)
    frequent = [part for _, colour in counts[:COLOURS] for part in colour]  # type: ignore[attr-defined, union-attr]
    between = picture.quantize(COLOURS, dither=Image.Dither.NONE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*frequent, *between[: 3 * COLOURS]])
    return picture.quantize(palette=palette, dither=Image.Dither.NONE)


def look_at_views(directory: Path) -> int:
    """Pictures of all views into `directory`; returns how many have a fault, which are printed."""
    directory.mkdir(parents=True, exist_ok=True)
    site, count = Site(), 0
    positions = {f"simulated/gw000{k}/s0": (0.1 + 0.1 * k, 0.5) for k in range(8)}
    with ExitStack() as opened:
        data = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        plan = FloorPlan(picture=IMAGES / "report.png", positions=positions)
        shown = opened.enter_context(page_site(site, data, plan=plan))
        gateway = Streaming(site, data / "streaming")
        opened.callback(gateway.close)
        shown.rounds(12)
        browser = opened.enter_context(chromium())
        for viewport, scheme in ((size, scheme) for size in (DESK, TABLET, PHONE) for scheme in ("light", "dark")):
            watched = Watched(browser, shown.served.address, viewport=viewport, color_scheme=scheme)
            page = watched.open()
            page.locator("#cards svg").first.wait_for()
            count += _look(page, directory, "fleet")
            page.locator("#cards a", has_text=shown.fleet.names_of("leaning")[0]).first.click()
            page.locator("#matrix table").first.wait_for()
            count += _look(page, directory, "sensor")
            watched.open("#view=plan").locator("#plan-picture .point").first.wait_for()
            count += _look(page, directory, "plan")
            gateway.show(watched.open("#view=live&site=site&gateway=gw&sensor=mems"))
            count += _look(page, directory, "live")
            watched.close()
    site.kill()
    return count


def _look(page: Any, directory: Path, view: str) -> bool:
    page.wait_for_timeout(SETTLES_MS)
    width, dark = page.viewport_size["width"], page.evaluate("() => matchMedia('(prefers-color-scheme: dark)').matches")
    name = f"{view}-{width}-{'dark' if dark else 'light'}"
    page.screenshot(path=directory / f"{name}.png", full_page=True)
    faults = axe_faults(page)
    if (wide := page.evaluate("() => document.documentElement.scrollWidth")) > width:
        faults.append(f"it is {wide} px wide")
    print(f"{name}: {'; '.join(faults) or 'no fault'}", flush=True)
    return bool(faults)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=Path, metavar="DIR", help="pictures of all views, and what axe-core finds")
    args = parser.parse_args()
    if args.views is not None:
        sys.exit(look_at_views(args.views) > 0)
    write_pictures()
