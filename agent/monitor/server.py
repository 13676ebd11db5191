"""The web server of the fleet page. It needs the extra `monitor` of the package."""

from __future__ import annotations

import asyncio
import csv
import io
import json
import re
import sqlite3
import threading
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from agent.monitor.advising import Advisor
from agent.monitor.database import Database
from agent.monitor.engines import DatabaseError
from agent.monitor.fleet import Fleet, Place
from agent.monitor.following import Following
from agent.monitor.forwarding import Forwarding
from agent.monitor.guard import Guard
from agent.monitor.live import Live
from agent.monitor.login import Access
from agent.monitor.notices import NoticeSender
from agent.monitor.plan import Plans
from agent.monitor.site_watching import SiteWatching
from agent.monitor.trends import Trends
from agent.terminal.text import no_formula

PAGE = Path(__file__).parent / "page"
TYPES = {".html": "text/html", ".svg": "image/svg+xml", ".js": "text/javascript", ".css": "text/css"}
FILES = {path.name: TYPES[path.suffix] for path in PAGE.iterdir() if path.suffix in TYPES}
HISTORY_MAX = 2000  # results of one kind that a page or a CSV file holds
PLOTTED = (
    "t_utc_ns", "sensitivity", "offset", "standard_uncertainty", "output_unit", "reference_temperature_degc",
    "temperature_low_degc", "temperature_high_degc", "references", "made_sequence",
)  # fmt: skip
_NUMBER = re.compile(r"[0-9]{1,9}")
_VERSION = re.compile(r"[0-9]{1,18}")
SEEN_MAX = 50  # sensors of which a page asks at once
LISTENERS_MAX = 50  # pages that are told of changes at the same time
TELL_S = 0.5  # s between two looks for a change
# s between two events that tell nothing else: they keep proxies from ending the stream, find clients that are gone, and
# tell a page that its connection still carries something.
ALIVE_S = 15.0


def application(
    data: PageData, access: Access, forwarding: Forwarding, live: Live, plans: Plans, names: Sequence[str] = ()
) -> ASGIApp:
    """The page, its data as JSON and CSV, and the stream of changes (server-sent events).

    `names`: host names by which browsers reach this server, besides localhost and IP addresses.
    """
    app = Starlette(
        routes=[
            Route("/api/fleet", access.reading(data.sensors)),
            Route("/api/trends", access.reading(data.trends)),
            Route("/api/history", access.reading(data.history)),
            Route("/api/spread", access.reading(data.spread)),
            Route("/api/hours", access.reading(data.hours)),
            Route("/hours.csv", access.reading(data.hours_csv)),
            Route("/gateways.csv", access.reading(data.gateways_csv)),
            Route("/api/changes", access.reading_async(data.changes)),
            Route("/plan", access.reading(plans.picture)),
            Route("/api/plan", access.reading(plans.positions)),
            Route("/api/plan/picture", plans.put_picture, methods=["POST"]),
            Route("/api/plan/position", plans.put_position, methods=["POST"]),
            Route("/fleet.csv", access.reading(data.sensors_csv)),
            Route("/sensor.csv", access.reading(data.history_csv)),
            Route("/api/live", access.reading_async(live.stream)),
            Route("/api/advice", access.reading(data.advice)),
            Route("/advice.csv", access.reading(data.advice_csv)),
            Route("/api/bench", access.reading(data.bench)),
            Route("/bench.csv", access.reading(data.bench_csv)),
            Route("/api/watch", access.reading(data.watch)),
            Route("/watch.csv", access.reading(data.watch_csv)),
            Route("/api/events", access.reading(data.events)),
            Route("/events.csv", access.reading(data.events_csv)),
            Route("/api/me", access.me),
            Route("/api/login", access.log_in, methods=["POST"]),
            Route("/api/logout", access.log_out, methods=["POST"]),
            Route("/api/command", forwarding.command, methods=["POST"]),
            Route("/", _file),
            Route("/{name}", _file),
        ],
        exception_handlers={sqlite3.Error: _no_database, DatabaseError: _no_database},
    )
    return Guard(GZipMiddleware(app, compresslevel=1), names)


def _file(request: Request) -> Response:
    name = request.path_params.get("name", "index.html")
    if name not in FILES:
        return Response("no such page", 404)
    return Response((PAGE / name).read_bytes(), 200, None, FILES[name])


def _no_database(_: Request, error: Exception) -> Response:
    return Response(f"the database cannot be read: {error}; try again", 503)


class PageData:
    """What the page asks for. `stopping` ends the streams, which a browser would keep open for ever.

    `notifier`: its fault is shown.
    """

    def __init__(
        self, database: Database, fleet: Fleet, following: Following, stopping: threading.Event,
        watching: SiteWatching, notifier: NoticeSender | None = None,
    ) -> None:  # fmt: skip
        self._database, self._fleet, self._following, self._stopping = database, fleet, following, stopping
        self._watching, self._notifier = watching, notifier
        self._advisor, self._trends = Advisor(database, fleet), Trends(database, fleet)
        self._listeners: set[object] = set()

    def sensors(self, request: Request) -> Response:
        following, fleet = self._following, self._fleet
        bus = following.state() | {"left_out": fleet.left_out, "verifies": following.keys is not None}
        bus["notices"] = self._notifier.fault if self._notifier is not None else ""
        fleet.look()
        return _json({"version": fleet.version, "now_utc_ns": time.time_ns(), "sensors": fleet.rows(_since(request)),
        "sites": self._watching.changed_sites(),
                      "gateways": fleet.gateways(following.refused), "bus": bus})  # fmt: skip

    def trends(self, request: Request) -> Response:
        """Of the sensors that are seen (`of`: site/gateway/sensor, at most SEEN_MAX), what their histories tell."""
        asked = request.query_params.getlist("of")[:SEEN_MAX]
        places = {name: name.split("/") for name in asked if name.count("/") == 2}
        return _json({name: self._trends.of((a, b, c)) for name, (a, b, c) in places.items()})

    def sensors_csv(self, _: Request) -> Response:
        return _csv("fleet.csv", self._fleet.rows())

    def events(self, _: Request) -> Response:
        return _json(self._fleet.events())

    def events_csv(self, _: Request) -> Response:
        return _csv("events.csv", self._fleet.events())

    def watch(self, request: Request) -> Response:
        """What is told of a site as a whole; null where nothing is."""
        return _json(self._watching.told.get(request.query_params.get("site", "")))

    def watch_csv(self, _: Request) -> Response:
        rows = [
            {"site": site, "until": told["until"], **one, "suspected": (one["suspected"] or {}).get("text", "")}
            for site, told in sorted(self._watching.told.items())
            for one in told["sensors"]
        ]
        return _csv("watch.csv", rows)

    def bench(self, request: Request) -> Response:
        """All sessions of `fieldcal bench`, and the guide of the one that is asked for."""
        benches, (site, gateway, _) = self._following.benches, _place(request)
        return _json({"benches": benches.rows(), "guide": benches.guide(site, gateway)})

    def bench_csv(self, request: Request) -> Response:
        return _csv("bench.csv", self._following.benches.stops(*_place(request)[:2]))

    def advice(self, request: Request) -> Response:
        return _json(self._advisor.advice(_place(request)))

    def advice_csv(self, request: Request) -> Response:
        return _csv("advice.csv", self._advisor.advice(_place(request)))

    def history(self, request: Request) -> Response:
        return _json(self._history(request))

    def spread(self, request: Request) -> Response:
        """Calibrations from the whole history, for plots."""
        rows = self._database.spread(*_place(request), "calibration", HISTORY_MAX)
        return _json([{name: row[name] for name in PLOTTED if name in row} for row in rows])

    def hours(self, request: Request) -> Response:
        return _json(self._database.summaries(*_place(request), _limit(request)))

    def hours_csv(self, request: Request) -> Response:
        return _csv("hours.csv", self._database.summaries(*_place(request), _limit(request)))

    def gateways_csv(self, _: Request) -> Response:
        return _csv("gateways.csv", self._fleet.gateways(self._following.refused))

    def history_csv(self, request: Request) -> Response:
        return _csv("sensor.csv", self._history(request))

    def _history(self, request: Request) -> list[dict[str, Any]]:
        rows = self._database.history(*_place(request), request.query_params.get("what", ""), _limit(request))
        return [{name: value for name, value in row.items() if name != "covariance"} for row in rows]

    async def changes(self, _: Request) -> Response:
        if len(self._listeners) >= LISTENERS_MAX:
            return Response("too many pages are open", 503)
        return StreamingResponse(self._tell(), 200, None, "text/event-stream")

    async def _tell(self) -> AsyncIterator[str]:
        me, told, benches = object(), -1, self._following.benches
        guided, silent_s = benches.version, 0.0
        if len(self._listeners) >= LISTENERS_MAX:
            return  # many came at the same moment; a page asks again
        self._listeners.add(me)
        try:
            while not self._stopping.is_set():
                silent_s += TELL_S
                self._fleet.look()
                if self._fleet.version != told:
                    told = self._fleet.version
                    yield f"data: {told}\n\n"
                if benches.version != guided:
                    guided = benches.version
                    yield f"event: bench\ndata: {guided}\n\n"
                if silent_s >= ALIVE_S:
                    silent_s = 0.0
                    yield "event: alive\ndata: 1\n\n"
                await asyncio.sleep(TELL_S)
        finally:
            self._listeners.discard(me)


def _place(request: Request) -> Place:
    site, gateway, sensor = (request.query_params.get(name, "") for name in ("site", "gateway", "sensor"))
    return site, gateway, sensor


def _since(request: Request) -> int:
    since = request.query_params.get("since", "")
    return int(since) if _VERSION.fullmatch(since) else 0


def _limit(request: Request) -> int:
    limit = request.query_params.get("limit", "")
    return min(int(limit), HISTORY_MAX) if _NUMBER.fullmatch(limit) else HISTORY_MAX


def _json(told: object) -> Response:
    return Response(msgspec.json.encode(told), 200, None, "application/json")


def _csv(name: str, rows: list[dict[str, Any]]) -> Response:
    text = io.StringIO()
    columns = list(dict.fromkeys(column for row in rows for column in row))
    writer = csv.writer(text)
    writer.writerow(map(no_formula, columns))
    writer.writerows([_cell(row.get(column)) for column in columns] for row in rows)
    return Response(text.getvalue(), 200, {"Content-Disposition": f'attachment; filename="{name}"'}, "text/csv")


def _cell(value: Any) -> Any:
    """A cell. A text that a spreadsheet would take for a formula gets an apostrophe before it."""
    if isinstance(value, (list, dict)):
        value = json.dumps(value)
    return no_formula(value) if isinstance(value, str) else value
