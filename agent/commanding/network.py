"""Commands that arrive as Zenoh queries on `<gateway>/<sensor>/command/<verb>`."""

from __future__ import annotations

import logging
import threading
from contextlib import ExitStack

import zenoh

from agent.commanding.desk import CommandDesk

# Commands that may wait. In a flood the oldest are dropped, so that other messages of the session are not delayed.
WAITING_MAX = 16
CLOSE_S = 1.0  # s to wait for the thread at the end; it is longer in a command only where a router does not respond
_log = logging.getLogger(__name__)
_Queryable = zenoh.Queryable[zenoh.Handler[zenoh.Query]]


def serve_queries(session: zenoh.Session, gateway: str, desk: CommandDesk, open_things: ExitStack) -> None:
    """Answer commands below the key `gateway` in a thread of their own. Closing `open_things` ends this."""
    queryable = session.declare_queryable(
        f"{gateway}/*/command/*", zenoh.handlers.RingChannel(WAITING_MAX), complete=True
    )
    commands = threading.Thread(target=_answer, args=(queryable, gateway, desk), name="commands", daemon=True)
    commands.start()
    open_things.callback(commands.join, CLOSE_S)
    open_things.callback(queryable.undeclare)


def _answer(queryable: _Queryable, gateway: str, desk: CommandDesk) -> None:
    for query in queryable:
        with query:  # without closing the query, the sender waits until its timeout
            key = str(query.key_expr)
            if "*" in key:
                continue  # a query for results with a wildcard arrives here too; it is not a command
            try:
                payload = query.payload.to_bytes() if query.payload is not None else b""
                answer = desk.receive(key.removeprefix(gateway + "/"), payload)
                query.reply(key, answer.json, encoding=zenoh.Encoding.APPLICATION_JSON)
            except zenoh.ZError as error:
                _log.warning("a command could not be answered: %s", error)
