"""Sends a command over Zenoh."""

from __future__ import annotations

import json
from collections.abc import Sequence

import zenoh

from agent.commanding.envelope import LARGEST
from agent.config.tls import TlsFiles
from agent.delivery.session import closed_in_time, session_config

CONNECT_S = 5.0
ANSWER_S = 5.0  # s; the agent answers after one fsync


def send(endpoints: Sequence[str], tls: TlsFiles | None, key: str, data: bytes) -> bytes:
    """Send the bytes of a command to the Zenoh key `key` through a router; returns the answer.

    Raises EndpointError for an invalid endpoint, ConnectionError where no router or no agent answers.
    """
    config = session_config("client", connect=endpoints, tls=tls)
    config.insert_json5("connect/timeout_ms", json.dumps(int(CONNECT_S * 1000)))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        hint = "; a router also gives no answer where it does not trust the certificate" if tls else ""
        raise ConnectionError(f"no Zenoh router answers at {', '.join(endpoints)}{hint}") from None
    with closed_in_time(session):
        # Target ALL, since the gateway's history answers on the same keys too. Consolidation would delay the answer.
        replies = session.get(
            key,
            payload=data,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ANSWER_S,
        )
        for reply in replies:
            if reply.ok is not None and str(reply.ok.key_expr) == key and len(reply.ok.payload) <= LARGEST:
                return reply.ok.payload.to_bytes()
    raise ConnectionError(
        f"nobody answers at {key}: there is no such gateway, its configuration does not enable commands, "
        f"or the router's rules do not let this command through"
    )
