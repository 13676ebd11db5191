"""Notices to people: what is told, when, and the thread that sends it to webhooks and by mail."""

from __future__ import annotations

import logging
import smtplib
import threading
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urlsplit

from cryptography.x509 import load_pem_x509_certificate

from agent.monitor.fleet import Fleet
from agent.monitor.messages import Notice, SomeRefusedError, fault_of, mail, post
from agent.monitor.settings import Notices

LOOK_S = 1.0  # s between two looks at the fleet
APART_S = 60.0  # s between two messages at least; each has all notices that came meanwhile
LATE_S = 30.0  # s after which a message that is on its way is told; each answer may take a third of it
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


class _Target:
    """A webhook or a mail server, and the notices that wait for it. Each message is sent in a thread of its own, so
    that a server that never comes to an end delays no other one. `name`: of the target, for people.
    """

    def __init__(self, name: str, send: Callable[[Sequence[Notice]], None]) -> None:
        self._name, self._send_to = name, send
        self._waiting: list[Notice] = []
        self._mutex = threading.Lock()
        self._thread: threading.Thread | None = None
        self._began_s = 0.0
        self._fault = ""

    def add(self, notices: Sequence[Notice]) -> None:
        """Let these notices wait. Of too many, the oldest are dropped."""
        with self._mutex:
            self._waiting += notices
            del self._waiting[:-WAITING_MAX]

    def begin(self) -> bool:
        """Begin to send what waits, unless a message is still on its way. Returns whether it was begun."""
        if not self._waiting or (self._thread is not None and self._thread.is_alive()):
            return False
        self._began_s = time.monotonic()
        self._thread = threading.Thread(target=self._send, name="notice", daemon=True)
        self._thread.start()
        return True

    def join(self, timeout_s: float) -> None:
        """Wait for a message that is on its way."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    @property
    def fault(self) -> str:
        """Why the last message was not sent; "" if it was, or is on its way."""
        late_s = time.monotonic() - self._began_s
        if self._thread is not None and self._thread.is_alive() and late_s > LATE_S:
            return self._unsent(f"the server has not come to an end for {late_s:.0f} s")
        return self._fault

    def _send(self) -> None:
        with self._mutex:
            sending, self._waiting = self._waiting, []
        try:
            self._send_to(tuple(sending))
        except (OSError, ValueError, HTTPException, smtplib.SMTPException, SomeRefusedError) as error:
            self._fault = self._unsent(fault_of(error))
            _log.warning("monitor: %s", self._fault)
            if not isinstance(error, SomeRefusedError):
                with self._mutex:
                    self._waiting = (sending + self._waiting)[-WAITING_MAX:]
        else:
            self._fault = ""

    def _unsent(self, why: str) -> str:
        return f"a notice could not be sent: {self._name}: {why}"


class NoticeSender:
    """Sends the notices of a watch, in threads, until `close`.

    A message has all notices since the one before. What could not be sent is tried again with the next message.
    """

    def __init__(self, watch: FleetWatch, settings: Notices) -> None:
        self._watch = watch
        self._targets = [_Target(f"webhook at {urlsplit(url).netloc}", partial(post, url)) for url in settings.webhooks]
        if (email := settings.email) is not None:
            self._targets.append(_Target(f"mail server {email.host}:{email.port}", partial(mail, email)))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="notices", daemon=True)
        self._thread.start()

    @property
    def fault(self) -> str:
        """Why the last messages were not sent; "" if they were."""
        return "; ".join(filter(None, (target.fault for target in self._targets)))

    def close(self) -> None:
        """End the thread. Messages on their way are waited for, 1 s at most."""
        self._stop.set()
        end_s = time.monotonic() + 1.0
        self._thread.join(1.0)
        for target in self._targets:
            target.join(max(0.0, end_s - time.monotonic()))

    def _run(self) -> None:
        sent_s = -APART_S
        while not self._stop.wait(LOOK_S):
            found = self._watch.update(time.monotonic(), datetime.now(UTC))
            for target in self._targets:
                target.add(found)
            begun = [target.begin() for target in self._targets] if time.monotonic() - sent_s >= APART_S else []
            if any(begun):
                sent_s = time.monotonic()
