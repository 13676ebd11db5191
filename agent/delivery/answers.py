"""Answers queries on a gateway's keys from its store: the values in force, or all results after a sequence number."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

import zenoh

from agent.delivery.history import History, StoredResult, StoreError
from agent.delivery.keys import result_key

REPLIES_MAX = 500  # results per query, about 1 MB; the consumer asks again from the last number until nothing comes
NOTHING = b"nothing to tell"
REMOVED = "no longer kept: some results up to "  # followed by the number; retention has deleted them

_log = logging.getLogger(__name__)
_Queryable = zenoh.Queryable[zenoh.Handler[zenoh.Query]]


def answer_queries(
    queryable: _Queryable, gateway: str, open_store: Callable[[], History], told: Callable[[], Mapping[str, bytes]]
) -> None:
    """Answer queries until the queryable is undeclared or its session closes. Runs in a thread of its own.

    `gateway`: Zenoh key of the gateway. `open_store`: opens its store to read it. `told`: gives what the gateway says
    of itself, JSON by the end of its key: `status`, `head`.
    A query for `<keys>` gets the newest result of each channel that matches, a calibration only while it is in force,
    and the gateway's status and head where their keys match.
    A query for `<keys>?after=<sequence>` gets the first REPLIES_MAX results after that number, in order. Several of
    them have the same key, so the query must use the consolidation NONE; otherwise Zenoh passes on only the last one.
    With `epoch=<epoch>;after=<sequence>` only results of this epoch are given.
    A signed result is in the attachment of its answer, as `attachment_of` makes it.
    Where retention has deleted some of these results, the error REMOVED comes first.
    Where there is no result, the answer is the error NOTHING: no answer at all would mean that the gateway is absent.
    """
    for query in queryable:
        with query:  # without closing the query, the sender waits until its timeout
            try:
                records, removed = _answers(query, gateway, open_store)
                replied = _reply_status(query, gateway, told())
                if removed:
                    query.reply_err(f"{REMOVED}{removed}")
                elif not records and not replied:
                    query.reply_err(NOTHING)
                for record in records:
                    query.reply(
                        result_key(gateway, record.sensor, record.what),
                        record.payload,
                        encoding=zenoh.Encoding.APPLICATION_JSON,
                        attachment=attachment_of(record) or None,
                    )
            except (StoreError, ValueError) as error:
                query.reply_err(str(error))
            except zenoh.ZError as error:
                _log.warning("a query could not be answered: %s", error)


def attachment_of(record: StoredResult, previous: str = "") -> bytes:
    """The attachment of a result: the number of the one before, and after a line break the signed result, if any."""
    return previous.encode() + (b"\n" + record.signed if record.signed else b"")


def _reply_status(query: zenoh.Query, gateway: str, told: Mapping[str, bytes]) -> bool:
    wanted = {} if "after" in query.parameters else {result_key(gateway, "", what): told[what] for what in told}
    matching = {key: value for key, value in wanted.items() if query.key_expr.intersects(key)}
    for key, value in matching.items():
        query.reply(key, value, encoding=zenoh.Encoding.APPLICATION_JSON)
    return bool(matching)


def _answers(query: zenoh.Query, gateway: str, open_store: Callable[[], History]) -> tuple[list[StoredResult], int]:
    """(the records asked for, the number up to which some of them have been deleted, or 0)."""
    after = query.parameters.get("after")
    with open_store() as history:
        wanted = [
            (sensor, what)
            for sensor, what in history.channels()
            if query.key_expr.intersects(result_key(gateway, sensor, what))
        ]
        if after is None:
            return [record for record in history.latest() if (record.sensor, record.what) in wanted], 0
        if not after.isascii() or not after.isdigit() or int(after) >= 2**63:
            raise ValueError(f"after={after}: not a sequence number")
        gone = [r.up_to for r in history.removed() if (r.sensor, r.what) in wanted and r.up_to > int(after)]
        epoch = query.parameters.get("epoch")
        return history.after(int(after), wanted, limit=REPLIES_MAX, epoch=epoch), max(gone, default=0)
