"""A thread of the monitor that watches each site as a whole: it sums days that have closed, and asks what has changed.

The site is watched anew from its days in binary each time, so hours that come late, other sensors and a restart need
nothing else. A site is asked when a day has closed, and rests REST times as long as that took.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent.monitor.database import Database
from agent.monitor.engines import DatabaseError
from agent.monitor.fleet import Fleet
from agent.monitor.watch_store import close_day, keep_verdict, sites_of, source_of, verdicts_of_sites
from agent.site_watch.suspicion import Suspicion
from agent.site_watch.view import as_object, watch_site
from calib.recorded.outcome import plain
from calib.site_watch.day import HOURS

LOOK_S = 30.0  # s between two looks for a day that has closed
PAUSE_S = 0.005  # s between two days, in which results are taken
REST = 10.0  # times the duration of a run over a site, in which it is not run again
DAY_NS = HOURS * 3600 * 10**9

_log = logging.getLogger(__name__)


class _StoppedError(Exception):
    """The monitor ends."""


class SiteWatching:
    """What is told of each site, by its name (`told`: the object of docs/site-watch.md), until `close`."""

    def __init__(self, database: Database, fleet: Fleet, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._database, self._fleet, self._clock_s = database, fleet, clock_s
        self._stop = threading.Event()
        self._changed: set[str] = set()
        self._rests: dict[str, float] = {}  # until when a site is not asked
        self.told: dict[str, dict[str, Any]] = {}
        for site, told in verdicts_of_sites(database.query).items():
            try:
                fleet.set_suspected(site, _suspicions(told), int(told["until_day"]) * DAY_NS, fresh=False)
            except (msgspec.ValidationError, KeyError, TypeError, ValueError):  # damaged on the disk: told anew
                continue
            self.told[site] = told
        self._changed.update(site for site in sites_of(database.query) if site not in self.told)
        self._thread = threading.Thread(target=self._run, name="site watch", daemon=True)

    def start(self) -> None:
        """Begin the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread, within one day of a site."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def step(self) -> None:
        """Sum all days that have closed, then ask each site of which one has, unless it rests."""
        while (site := close_day(self._database.query)) is not None:
            self._changed.add(site)
            self._turn()
        for site in sorted(self._changed):
            begin_s = self._clock_s()
            if begin_s >= self._rests.get(site, -np.inf):
                self._changed.discard(site)
                self._ask(site)
                end_s = self._clock_s()
                self._rests[site] = end_s + REST * (end_s - begin_s)

    def changed_sites(self) -> list[dict[str, Any]]:
        """The sites of which the structure has changed: `site`, `what`, `since`, `earliest`, `latest`."""
        names = "since", "earliest", "latest"
        return [
            {"site": site, "what": _change_text(told["site"])} | {name: told["site"][name] for name in names}
            for site, told in sorted(self.told.items())
            if told["site"]["verdict"] == "structure"
        ]

    def _ask(self, site: str) -> None:
        source = source_of(self._database.query, site, closed=True, turn=self._turn)
        if not source.sensors:
            return
        source.left_out = Counter(self._database.watch.left_out)  # of all sites, since the start
        view = watch_site(source)
        told = plain(as_object(view)) | {"until_day": view.found.day}
        before, self.told[site] = self.told.get(site), msgspec.json.decode(msgspec.json.encode(told))
        structure = self.told[site]["site"]
        if structure["verdict"] == "structure" and (before is None or before["site"]["verdict"] != "structure"):
            text = f"structure: {_change_text(structure)} since {structure['since']}"
            self._fleet.note((site, "all", "structure"), "watch", view.found.day * DAY_NS + DAY_NS, text, alarm=True)
        keep_verdict(self._database.query, site, view.found.day, self.told[site])
        self._fleet.set_suspected(site, _suspicions(self.told[site]), view.found.day * DAY_NS + DAY_NS)

    def _turn(self) -> None:
        if self._stop.wait(PAUSE_S):
            raise _StoppedError

    def _run(self) -> None:
        while True:
            try:
                self.step()
            except _StoppedError:
                return
            except (sqlite3.Error, DatabaseError) as error:
                _log.warning("monitor: sites are not watched: %s", error)
            except Exception as error:
                place = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{Path(place.filename).name}:{place.lineno}"
                what = (
                    "monitor: a fault of this program, please report it: %s in %s: %.200s; a site is not watched today"
                )
                _log.warning(what, type(error).__name__, where, error)
            if self._stop.wait(LOOK_S):
                return


def _suspicions(told: dict[str, Any]) -> dict[tuple[str, str], Suspicion]:
    """What is suspected of sensors, by gateway and name."""
    found = (msgspec.convert(one["suspected"], Suspicion) for one in told["sensors"] if one.get("suspected"))
    return {(one.gateway, one.sensor): one for one in found}


def _change_text(told: dict[str, Any]) -> str:
    """What has changed of a structure, with its size where there is one."""
    size, U = told["size"], told["expanded_uncertainty"]
    return told["what"] if size is None or U is None else f"{told['what']}, by {size:+.2f} ± {U:.2f} %"
