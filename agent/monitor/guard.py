"""What every request must pass, and what every answer carries, so that no other web page can use the monitor."""

from __future__ import annotations

import ipaddress
import logging
import re
from collections.abc import Iterable

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from agent.delivery.seldom import Seldom

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Accel-Buffering": "no",  # nginx would keep changes back until they fill its buffer
}
READING = ("GET", "HEAD")
LOG_S = 60.0  # s between two lines of the log about answers that failed
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:[0-9]{1,5})?")


class Guard:
    """Passes requests on to `app` that name this server and come from its own page; adds HEADERS to every answer.

    The name in the header `Host` must be `localhost`, an IP address or one of `names`. So a page of another site cannot
    read the monitor by giving its own name this server's address (DNS rebinding): the browser sends that name.
    A request that may change something must have an `Origin` that is this server (cross-site request forgery).
    An answer that fails is logged in one line, and the server goes on.
    """

    def __init__(self, app: ASGIApp, names: Iterable[str] = ()) -> None:
        self._app = app
        self._names = {"localhost", *(name.lower() for name in names)}
        self._told = Seldom(logging.getLogger(__name__), LOG_S)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        fault = self._fault(scope)
        answer = PlainTextResponse(fault, 400) if fault else self._app
        try:
            await answer(scope, receive, send_with_headers)
        except Exception as error:  # the application has answered with 500
            what = "monitor: a fault of this program, please report it: %s at %.80r: %.200s"
            self._told.warning(what, type(error).__name__, scope["path"], error)

    def _fault(self, scope: Scope) -> str:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        match = _HOST.fullmatch(host)
        if match is None or not (match[1].lower() in self._names or _is_address(match[1])):
            return f"this server does not answer as {host!r:.80}; start it with --host NAME to let it"
        if scope["method"] in READING:
            return ""
        origin = headers.get("origin", "")
        if origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            return f"a request of another page, of origin {origin!r:.80}"
        return ""


def _is_address(text: str) -> bool:
    """Whether this is an IPv4 address, or an IPv6 address in brackets."""
    try:
        version = ipaddress.ip_address(text.strip("[]")).version
    except ValueError:
        return False
    return (version == 6) == text.startswith("[")
