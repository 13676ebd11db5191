"""A fleet on the bus, the page in a browser, and the pictures of the documentation.

`python -m tests.scenarios.fleet_page` writes docs/images/fleet*.png.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from agent.commanding.network import serve_queries
from agent.core.events import Acceleration, Estimate
from agent.delivery.history import Record
from agent.delivery.keys import gateway_key
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.fleet.simulated import SimulatedFleet
from agent.recording.acceleration import encode_acceleration
from tests.unit.browser import Watched, chromium
from tests.unit.command_desk import GATEWAY, DeskSite
from tests.unit.monitor_site import Served
from tests.unit.results import calibration
from tests.unit.zenoh_site import Site, record, wait_for

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
    "fleet-phone": (PHONE, "light"),
}  # fmt: skip
IMAGES = Path(__file__).parents[2] / "docs" / "images"


@dataclass
class PageSite:
    """A simulated fleet and the page of it. `made`: rounds that the fleet has made, ten days apart."""

    served: Served
    fleet: SimulatedFleet
    made: int = 0

    def rounds(self, count: int, every_days: float = 10.0) -> None:
        """Let the fleet make so many rounds of results, the last of all 30 being of today."""
        for _ in range(count):
            # Of a gateway that the monitor meets for the first time it takes the newest results alone.
            wait_for(lambda: not self.made or len(self.served.fleet.rows()) == len(self.fleet.gateways) * 2)
            self.fleet.step(time.time_ns() - round((29 - self.made) * every_days * DAY_NS))
            self.made += 1


@contextmanager
def page_site(site: Site, directory: Path, **options: Any) -> Iterator[PageSite]:
    """Eight gateways with two sensors each, of which four are odd."""
    with (
        Served(site, directory / "monitor", **options) as served,
        SimulatedFleet(8, 2, SEED, [site.endpoint], directory / "fleet") as fleet,
    ):
        yield PageSite(served, fleet)


class CommandedGateway:
    """A gateway with one sensor and a calibration, that takes anna's commands."""

    def __init__(self, site: Site, directory: Path) -> None:
        directory.mkdir()
        self.desk = DeskSite(directory)
        self._store = Store(directory)
        place = gateway_key(*GATEWAY.split("/"))

        def serve(session: zenoh.Session, opened: ExitStack) -> None:
            serve_queries(session, place, self.desk.desk, opened)

        self._publisher = Publisher(*GATEWAY.split("/"), [site.endpoint], self._store, serve=serve)
        self._publisher.start()

    def publish_more(self) -> int:
        """A second calibration with all that the page can show, and an estimate, whose number this returns."""
        first = self._store.last_sequence() + 1
        estimate = Estimate(run_id="r", sequence=first + 1, sensor="mems", t_utc_ns=time.time_ns(),
                            reason="Sxx changed by 4 U", calibration=calibration(first + 1))  # fmt: skip
        known = {"response": RESPONSE, "reference_frequency_hz": 5.0, "reference_temperature_degc": 21.0,
                 "temperature_low_degc": 15.0, "temperature_high_degc": 30.0, "references": ["B12 4711"]}  # fmt: skip
        self.publish([record(first, "calibration", **known),
                      Record.of(estimate, recorded=True, recording="f.mcap", epoch=""),
                      record(first + 2, "clock")])  # fmt: skip
        return first + 1

    def publish(self, records: Sequence[Record]) -> None:
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
    """What one screen says of the five worst: which (`who`, `kind`), since when, how sure and why (`say`, `more`), and
    what next (`next`). Only what a person sees without scrolling."""
    found: list[dict[str, str]] = page.evaluate(
        """() => [...document.querySelectorAll('#cards .card')].filter((card) => {
            const { top, bottom } = card.getBoundingClientRect();
            return top >= 0 && bottom <= innerHeight;
        }).map((card) => ({ who: card.querySelector('h3 a')?.textContent ?? card.querySelector('h3').textContent,
            kind: card.querySelector('.chip').textContent, say: card.querySelector('.say').textContent,
            more: card.querySelector('.more').textContent, next: card.querySelector('.do').textContent }))"""
    )
    return found


def write_pictures() -> None:
    """The page with a fleet of 300 days: the fleet at three widths and dark, a sensor on a desk, light and dark."""
    site = Site()
    with tempfile.TemporaryDirectory() as directory, page_site(site, Path(directory)) as shown, chromium() as browser:
        shown.rounds(30)
        for name, (viewport, scheme) in VIEWS.items():
            watched = Watched(browser, shown.served.address, viewport=viewport, color_scheme=scheme)
            page = watched.open()
            page.locator("#cards svg").first.wait_for()
            page.wait_for_timeout(500)  # of drawing
            page.screenshot(path=IMAGES / f"{name}.png")
            if viewport is not DESK:
                watched.close()
                continue
            page.locator("#cards a").first.click()
            page.locator("#matrix table").first.wait_for()
            page.wait_for_timeout(500)
            page.screenshot(path=IMAGES / f"{name.replace('fleet', 'fleet-sensor')}.png")
            watched.close()
    site.kill()


if __name__ == "__main__":
    write_pictures()
    sys.exit(0)
