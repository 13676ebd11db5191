"""Notices to people: what is told, when, and the thread that sends it to webhooks and by mail."""

from __future__ import annotations

import logging
import smtplib
import threading
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography.x509 import load_pem_x509_certificate

from agent.monitor.fleet import Fleet
from agent.monitor.messages import Notice, mail, post
from agent.monitor.settings import Notices

LOOK_S = 1.0  # s between two looks at the fleet
APART_S = 60.0  # s between two messages at least; each has all notices that came meanwhile
WAITING_MAX = 1000  # notices that wait while nothing can be sent; the oldest are dropped
CERTIFICATES_S = 3600.0  # s between two looks at the certificates
AGAIN = timedelta(days=7)  # after which a certificate that ends is told again

_log = logging.getLogger(__name__)


class FleetWatch:
    """What is told of a fleet. `update` takes the time, so that the same fleet gives the same notices."""

    def __init__(self, fleet: Fleet, settings: Notices, certificates: Sequence[Path]) -> None:
        self._fleet, self._settings, self._certificates = fleet, settings, certificates
        self._silent_since: dict[tuple[str, str], float] = {}
        self._told_silent: set[tuple[str, str]] = set()
        self._told_doubled: set[tuple[str, str]] = set()
        self._told_certificates: dict[Path, datetime] = {}
        self._looked_s = -CERTIFICATES_S

    def update(self, now_s: float, now: datetime) -> list[Notice]:
        """The notices since the last call. `now_s`: monotonic time in s; `now`: UTC."""
        found = [
            Notice(e["what"], f"{e['site']}/{e['gateway']}/{e['sensor']}", e["text"]) for e in self._fleet.alarms()
        ]
        found += self._silent(now_s)
        if now_s - self._looked_s >= CERTIFICATES_S:
            self._looked_s = now_s
            found += self._ending(now)
        return found

    def _silent(self, now_s: float) -> list[Notice]:
        found = []
        for row in self._fleet.gateways({}):
            place = (row["site"], row["gateway"])
            if row["instances"] > 1 and place not in self._told_doubled:
                self._told_doubled.add(place)
                found.append(Notice("gateway", "/".join(place), "more than one gateway is on the bus under this name"))
            elif row["instances"] == 1:
                self._told_doubled.discard(place)
            if row["alive"]:
                self._silent_since.pop(place, None)
                if place in self._told_silent:
                    self._told_silent.discard(place)
                    found.append(Notice("gateway", "/".join(place), "the gateway is on the bus again"))
                continue
            since_s = self._silent_since.setdefault(place, now_s)
            told = place in self._told_silent or row["retired"] or not row["sensors"]  # a stranger may invent gateways
            if now_s - since_s >= self._settings.silent_s and not told:
                self._told_silent.add(place)
                words = f"the gateway has not been on the bus for {now_s - since_s:.0f} s"
                found.append(Notice("gateway", "/".join(place), words))
        return found

    def _ending(self, now: datetime) -> list[Notice]:
        found = []
        for path in self._certificates:
            try:
                ends = load_pem_x509_certificate(path.read_bytes()).not_valid_after_utc
            except (OSError, ValueError):
                continue
            told = self._told_certificates.get(path)
            soon = ends - now < timedelta(days=self._settings.certificate_days)
            if soon and (told is None or now - told >= AGAIN):
                self._told_certificates[path] = now
                over = "ended" if ends < now else "ends"
                found.append(Notice("certificate", path.name, f"the certificate {over} on {ends:%Y-%m-%d %H:%M} UTC"))
        return found


class NoticeSender:
    """Sends the notices of a watch, in a thread, until `close`.

    `fault`: why the last message was not sent; "" if it was. A message has all notices since the one before. What could
    not be sent is tried again with the next message.
    """

    def __init__(self, watch: FleetWatch, settings: Notices) -> None:
        self.fault = ""
        self._watch = watch
        self._targets: list[Callable[[Sequence[Notice]], None]] = [
            lambda notices, url=url: post(url, notices)  # type: ignore[misc]
            for url in settings.webhooks
        ]
        if (email := settings.email) is not None:
            self._targets.append(lambda notices: mail(email, notices))
        self._waiting: list[list[Notice]] = [[] for _ in self._targets]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="notices", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread. A message on its way is waited for, 1 s at most."""
        self._stop.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        sent_s = -APART_S
        while not self._stop.wait(LOOK_S):
            found = self._watch.update(time.monotonic(), datetime.now(UTC))
            for waiting in self._waiting:
                waiting += found
                del waiting[:-WAITING_MAX]
            if any(self._waiting) and time.monotonic() - sent_s >= APART_S:
                sent_s = time.monotonic()
                self._send()

    def _send(self) -> None:
        faults = []
        for target, waiting in zip(self._targets, self._waiting, strict=True):
            if not waiting:
                continue
            try:
                target(tuple(waiting))
                waiting.clear()
            except (OSError, ValueError, smtplib.SMTPException) as error:
                faults.append(f"a notice could not be sent: {error}")
                _log.warning("monitor: %s", faults[-1])
        self.fault = "; ".join(faults)
