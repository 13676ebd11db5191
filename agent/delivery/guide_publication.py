"""Publishes what the guide of `fieldcal bench` says, at once and then again and again, so that nobody has to ask."""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

import msgspec
import zenoh

from agent.config.tls import TlsFiles
from agent.delivery.guide import WHAT, Guide, signature_of
from agent.delivery.keys import gateway_key, result_key
from agent.delivery.session import closed_in_time, session_config

if TYPE_CHECKING:
    from agent.recording.signing import Signer

REPEAT_S = 2.0  # s after which the same is said again: to a page that came later, and as a sign of life
LEAST_S = 0.2  # s between two messages
REOPEN_S = 5.0
SETTLE_S = 0.2  # s for a new router to name its subscribers
CLOSE_S = 1.2

_log = logging.getLogger(__name__)


class GuidePublisher:
    """Context in which `show` publishes a guide. It never delays the session, and needs no router.

    `site`, `gateway`: names. `connect`: endpoints of routers. `signer`: of the gateway's key, where it has one.
    Raises ValueError for an invalid name, EndpointError for an invalid endpoint.
    """

    def __init__(
        self,
        site: str,
        gateway: str,
        connect: Sequence[str],
        tls: TlsFiles | None = None,
        signer: Signer | None = None,
    ) -> None:
        self._key = result_key(gateway_key(site, gateway), "", WHAT)
        self._source = f"{site}/{gateway}"
        self._config = session_config("peer", connect=connect, tls=tls, one_of_many=True)
        self._signer = signer
        self._newest: Guide | None = None
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="guide", daemon=True)

    def __enter__(self) -> Self:
        atexit.register(self.close)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def show(self, guide: Guide) -> None:
        """Publish this from now on. Returns at once."""
        self._newest = guide
        self._wake.set()

    def close(self) -> None:
        """Publish the newest once more if a router is connected, and end. May be called twice."""
        atexit.unregister(self.close)
        self._stop.set()
        self._wake.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with closed_in_time(zenoh.open(self._config)) as session:
                    self._serve(session)
            except zenoh.ZError as error:
                _log.warning("the page of the monitor does not show this bench: %s", error)
                self._stop.wait(REOPEN_S)

    def _serve(self, session: zenoh.Session) -> None:
        stopping = connected = False
        while not stopping:
            stopping = self._stop.is_set()  # read first: the last round then sends what was shown last
            self._wake.clear()
            before, connected = connected, bool(session.info.routers_zid())
            if connected and not before:
                self._stop.wait(SETTLE_S)
            if connected and (guide := self._newest) is not None:
                self._put(session, guide)
            if not stopping:
                self._stop.wait(LEAST_S)
                self._wake.wait(REPEAT_S if connected else LEAST_S)

    def _put(self, session: zenoh.Session, guide: Guide) -> None:
        payload = msgspec.json.encode(guide)
        signed = signature_of(payload, self._source, self._signer) if self._signer is not None else None
        session.put(self._key, payload, encoding=zenoh.Encoding.APPLICATION_JSON, attachment=signed)
