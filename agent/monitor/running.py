"""All parts of the monitor together: database, bus, notices and web server, until Ctrl-C."""

from __future__ import annotations

import logging
import signal
import socket
import threading
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from agent.config.tls import TlsFiles
from agent.monitor.connections import SELDOMLY, Connections
from agent.monitor.database import Database
from agent.monitor.engines import open_engine
from agent.monitor.fleet import Fleet
from agent.monitor.following import Following
from agent.monitor.forwarding import Forwarding
from agent.monitor.live import Live
from agent.monitor.login import Access
from agent.monitor.notices import FleetWatch, NoticeSender
from agent.monitor.plan import Plans
from agent.monitor.server import PageData, application
from agent.monitor.settings import MonitorSettings
from agent.monitor.site_watching import SiteWatching
from agent.monitor.summaries import Summariser

PROXIES = ("127.0.0.1", "::1")  # whose X-Forwarded-For is believed with --behind-proxy
GRACE_S = 2  # s in which answers on their way may end at Ctrl-C


@dataclass(frozen=True, kw_only=True)
class BusAccess:
    """Routers, the files of a consumer (`tls`) and of a commander, and the list of known keys."""

    endpoints: Sequence[str]
    tls: TlsFiles | None
    commander: TlsFiles | None
    keys: Path | None


@dataclass(frozen=True, kw_only=True)
class Web:
    """Names of the server, who may log in, and HTTPS: the certificate with its key, or a proxy on this machine."""

    names: Sequence[str]
    users: Path | None
    certificate: Path | None
    key: Path | None
    behind_proxy: bool


class _Server(uvicorn.Server):
    """Ends the streams of open pages at Ctrl-C, which would otherwise be cut with an error."""

    def __init__(self, config: uvicorn.Config, stopping: threading.Event) -> None:
        super().__init__(config)
        self._stopping = stopping

    def handle_exit(self, sig: int, frame: Any) -> None:
        self._stopping.set()
        super().handle_exit(sig, frame)


def serve(listening: socket.socket, data_dir: Path, bus: BusAccess, web: Web, settings: MonitorSettings) -> None:
    """Serve the page on a socket that listens, until Ctrl-C or SIGTERM.

    Raises EndpointError, KeyFileError, UsersError, or sqlite3.Error or DatabaseError where the database cannot
    be used.
    """
    fleet, stopping = Fleet(retired=settings.fleet.retired), threading.Event()
    access, live = Access(web.users), Live(bus.endpoints, bus.tls, stopping)
    forwarding = Forwarding(bus.endpoints, bus.commander, access, fleet)
    with ExitStack() as stack:
        kept = settings.database
        engine = open_engine(data_dir, kept.url)
        database = stack.enter_context(closing(Database(engine, full_days=kept.full_days)))
        plans = Plans(engine, access, settings.plan)
        stack.callback(Summariser(database.summarise).close)
        following = Following(bus.endpoints, bus.tls, database, fleet, bus.keys)
        stack.callback(following.close)
        watching = SiteWatching(database, fleet)
        watching.start()
        stack.callback(watching.close)
        notifier = None
        if settings.notices is not None:
            notifier = NoticeSender(FleetWatch(fleet, settings.notices, _certificates(bus, web)), settings.notices)
            stack.callback(notifier.close)
        data = PageData(database, fleet, following, stopping, watching, notifier)
        app = application(data, access, forwarding, live, plans, web.names)
        server, bounded = web_server(app, listening, web, stopping)
        # The server raises the signal again that has ended it; SIGTERM would then end the process before what is below.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with suppress(KeyboardInterrupt):
            server.run([bounded])


def web_server(
    app: ASGIApp, listening: socket.socket, web: Web, stopping: threading.Event
) -> tuple[uvicorn.Server, socket.socket]:
    """The web server of an application, and the socket with which to run it, in place of `listening`."""
    # Outside of what tells it a proxy's client: a connection is known by its own address.
    connections = Connections(ProxyHeadersMiddleware(app, list(PROXIES)) if web.behind_proxy else app)  # type: ignore[arg-type]
    config = uvicorn.Config(
        connections, log_level="warning", timeout_graceful_shutdown=GRACE_S, server_header=False,
        ssl_certfile=web.certificate, ssl_keyfile=web.key, proxy_headers=False, loop="asyncio", http="h11", ws="none",
    )  # fmt: skip
    for name in ("uvicorn.error", "asyncio"):
        logging.getLogger(name).addFilter(SELDOMLY)
    return _Server(config, stopping), connections.listening(listening)


def _certificates(bus: BusAccess, web: Web) -> list[Path]:
    """The certificates of this monitor whose end is told."""
    named = [name for files in (bus.tls, bus.commander) if files is not None for name in (files.ca, files.certificate)]
    return [Path(name) for name in dict.fromkeys(named)] + ([web.certificate] if web.certificate is not None else [])
