"""Forwards signed commands from the page to the gateways. Neither the page nor the server has a key."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence

import anyio
from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from agent.commanding.allowance import RateLimit
from agent.commanding.arguments import VERBS
from agent.commanding.envelope import LARGEST, from_line, parse_envelope
from agent.commanding.refusal import Refused
from agent.commanding.sending import send
from agent.config.tls import TlsFiles
from agent.delivery.keys import CHUNK, gateway_key
from agent.monitor.fleet import Fleet
from agent.monitor.login import Access, body_of

AT_ONCE = 4  # commands that wait for an answer, up to 10 s each
FORWARDED = (20, 1.0)  # commands at once, then one a second: what a gateway takes
_log = logging.getLogger(__name__)


class Forwarding:
    """Sends signed commands through the routers at `endpoints`; `tls`: the files of a commander, where TLS is used.

    What became of each command is an event of the fleet, and in the log.
    """

    def __init__(self, endpoints: Sequence[str], tls: TlsFiles | None, access: Access, fleet: Fleet) -> None:
        self._endpoints, self._tls, self._access, self._fleet = endpoints, tls, access, fleet
        self._allowance = RateLimit(*FORWARDED)
        self._at_once = anyio.CapacityLimiter(AT_ONCE)

    async def command(self, request: Request) -> Response:
        """POST of a signed line of `fieldcal command --print`; the query names site, gateway, sensor and verb.

        The answer is that of the gateway, 200 with `taken` and `reason`; 502 where nobody answers.
        """
        asked = request.query_params
        site, gateway, sensor, verb = (asked.get(name, "") for name in ("site", "gateway", "sensor", "verb"))
        user = self._access.commanding(request, verb)
        data = from_line(await body_of(request, LARGEST))
        if verb not in VERBS or not all(map(CHUNK.fullmatch, (site, gateway, sensor))):
            raise HTTPException(400, "not the address of a command")
        try:
            key_id = parse_envelope(data).key_id
        except Refused as refused:
            raise HTTPException(400, f"not a signed command: {refused}") from None
        if not self._allowance.passes(time.monotonic()):
            raise HTTPException(429, "too many commands; wait a few seconds and send it again")
        key = f"{gateway_key(site, gateway)}/{sensor}/command/{verb}"
        try:
            said = await anyio.to_thread.run_sync(send, self._endpoints, self._tls, key, data, limiter=self._at_once)
            answer = json.loads(said)
            told = {"taken": answer["taken"] is True, "reason": str(answer["reason"])}
        except (ConnectionError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            self._note(asked, f"{verb} by {user.name}, key {key_id}: {error}")
            raise HTTPException(502, f"no answer: {error}") from None
        outcome = "taken" if told["taken"] else f"refused: {told['reason']}"
        self._note(asked, f"{verb} by {user.name}, key {key_id}: {outcome}")
        return JSONResponse(told)

    def _note(self, asked: QueryParams, words: str) -> None:
        site, gateway, sensor = asked["site"], asked["gateway"], asked["sensor"]
        self._fleet.note((site, gateway, sensor), "command", time.time_ns(), words)
        _log.warning("%s/%s/%s: %s", site, gateway, sensor, words)
