"""The sessions of `fieldcal bench` that the page shows: the newest guide of each gateway."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import msgspec

from agent.delivery.guide import Guide
from agent.delivery.keys import CHUNK

# A stranger may invent gateways for ever. The one that was heard longest ago gives way, and a session that goes on
# says the same again every two seconds.
BENCHES_MAX = 100
# s after the last guide from which an older one is taken: the clock of the gateway was put back, or one guide came from
# the future. A session that goes on is heard more often.
BACK_S = 10.0

Gateway = tuple[str, str]  # site, gateway


@dataclass(frozen=True, slots=True)
class _BenchArrival:
    guide: Guide
    at_s: float  # monotonic, when it came


class Benches:
    """`version` rises with every change of a guide. May be used by several threads."""

    def __init__(self) -> None:
        self.version = 0
        self._newest: dict[Gateway, _BenchArrival] = {}  # the one that was heard last is the last
        self._mutex = threading.Lock()

    def take(self, site: str, gateway: str, guide: Guide) -> None:
        """Take a guide, unless it is older than one just heard, or of a name that no gateway can have."""
        if not (CHUNK.fullmatch(site) and CHUNK.fullmatch(gateway)):
            return
        with self._mutex:
            before = self._newest.get((site, gateway))
            now_s = time.monotonic()
            if before is not None and guide.t_utc_ns < before.guide.t_utc_ns and now_s - before.at_s < BACK_S:
                return  # one that was recorded and sent again
            self._newest.pop((site, gateway), None)
            self._newest[site, gateway] = _BenchArrival(guide, now_s)
            if len(self._newest) > BENCHES_MAX:
                del self._newest[next(iter(self._newest))]
            self.version += before is None or before.guide != guide

    def rows(self) -> list[dict[str, Any]]:
        """One row for each session, the one that was heard last first."""
        now_s = time.monotonic()
        with self._mutex:
            return [
                {"site": site, "gateway": gateway, "sensor": heard.guide.sensor, "stage": heard.guide.stage,
                 "age_s": now_s - heard.at_s}
                for (site, gateway), heard in reversed(self._newest.items())
            ]  # fmt: skip

    def guide(self, site: str, gateway: str) -> dict[str, Any] | None:
        """The newest guide of a gateway, as it was published; None where there is none."""
        with self._mutex:
            heard = self._newest.get((site, gateway))
        return None if heard is None else msgspec.to_builtins(heard.guide)

    def stops(self, site: str, gateway: str) -> list[dict[str, Any]]:
        """One row for each position that was taken, with U after it."""
        with self._mutex:
            heard = self._newest.get((site, gateway))
        taken = heard.guide.taken if heard is not None else []
        return [
            {"stop": number, "position": each.name, "u_main_pct": each.expanded.main_pct,
             "u_transverse_pct": each.expanded.transverse_pct}
            for number, each in enumerate(taken, start=1)
        ]  # fmt: skip
