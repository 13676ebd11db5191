"""A command sent over Zenoh."""

from __future__ import annotations

import json
from collections.abc import Sequence

import zenoh

from agent.commanding.envelope import LARGEST
from agent.config.tls import TlsFiles
from agent.delivery.session import session_config

CONNECT_S = 5.0
ANSWER_S = 5.0  # the agent answers within one fsync


def send(endpoints: Sequence[str], tls: TlsFiles | None, key: str, data: bytes) -> bytes:
    """Send a command to its `key` through a router; the answer.

    Raises EndpointError, or ConnectionError where nobody answers.
    """
    config = session_config("client", connect=endpoints, tls=tls)
    config.insert_json5("connect/timeout_ms", json.dumps(int(CONNECT_S * 1000)))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        hint = "; a router that does not trust the certificate answers nothing" if tls else ""
        raise ConnectionError(f"no Zenoh router answers at {', '.join(endpoints)}{hint}") from None
    with session:
        # All: the gateway's history answers on the same keys. Without consolidation the first answer is not held back.
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
        f"nobody answers at {key}: no such gateway, it takes no commands, or the router does not let this through"
    )
