"""Hostile results, names and payloads for a consumer on the bus, drawn by a seed."""

from __future__ import annotations

import random
import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from typing import Any, NamedTuple

import msgspec
import zenoh

from agent.core.events import DriftReport, Estimate, Result
from agent.delivery.answers import NOTHING, REPLIES_MAX
from tests.unit.results import calibration, clock, status, window
from tests.unit.zenoh_site import Site

# As JSON, since not all of them are values of Python.
LEAVES = ("1" + "0" * 30, "-1" + "0" * 400, str(2**63), str(-(2**63) - 1), str(2**64 - 1), str(2**63 - 1),
          "1e308", "-1e308", "5e-324", "1e999", "NaN", "Infinity", "-0.0", "null", "true", "0", "-1", '""', '"=cmd()"',
          '"\\u0000"', '"\\ud800"', '"\\u202e"', '"' + "x" * 5000 + '"', "[]", "{}", "[[]]", '{"a": 1}',
          "[" * 40 + "]" * 40, "[" * 3000 + "]" * 3000)  # fmt: skip
ADDED = ("calibration", "shared_errors", "covariance", "response", "signed_by", "recorded", "epoch", "parameter",
         "used", "=cmd()", "", "__proto__", "\u202e", "x" * 300)  # fmt: skip
NAMES = (
    "mems",
    "alive",
    "status",
    "command",
    "..",
    "~",
    "x" * 64,
    "é",
    "a b",
    "<script>",
    "=cmd()",
    "-1",
    "%00",
    "CON",
)
_MARK = "#hostile#"


class Sent(NamedTuple):
    """One message: `sensor` and `what` of its key, its payload, and its attachment."""

    sensor: str
    what: str
    payload: bytes
    attachment: bytes


class HostileGateway:
    """A gateway whose store confirms whatever it publishes."""

    def __init__(self, site: Site, name: str) -> None:
        self._key = f"fieldcal/v1/site/{name}"
        self._kept: list[tuple[str, bytes]] = []  # (end of the key, payload), by number from 1
        self._open = ExitStack()
        self._session = self._open.enter_context(site.client())
        self._session.declare_queryable(f"{self._key}/**", self._answer)
        self._session.liveliness().declare_token(f"{self._key}/alive")

    def publish(self, sensor: str, what: str, payload: bytes) -> None:
        """Publish a result, whose payload has the next number from 1."""
        self._kept.append((f"{sensor}/{what}", payload))
        self._session.put(f"{self._key}/{sensor}/{what}", payload, attachment=str(len(self._kept) - 1))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            after = int(query.parameters.get("after") or 0)
            for end, payload in self._kept[after : after + REPLIES_MAX]:
                query.reply(f"{self._key}/{end}", payload)
            if after >= len(self._kept):
                query.reply_err(NOTHING)

    def close(self) -> None:
        self._open.close()


def kinds(sequence: int, sensor: str) -> list[Result]:
    """A sound result of each kind."""
    made = calibration(sequence)
    drift = DriftReport(run_id="r", sequence=sequence, sensor=sensor, t_utc_ns=1, parameter="Sxx", verdict="stepped",
                        change=1.0, u_change=1.0, rate=0.0, u_rate=0.0, onset_utc_ns=1, statistic=1.0, threshold=1.0,
                        false_alarms_a_year=0.1, reason="r")  # fmt: skip
    estimate = Estimate(run_id="r", sequence=sequence, sensor=sensor, t_utc_ns=1, reason="r", calibration=made)
    each = (made, window(sequence), status(sequence, "HELD"), drift, estimate, clock(sequence))
    return [msgspec.structs.replace(result, sensor=sensor) for result in each]


def payloads(seed: int, count: int, first: int, sensor: str = "mems") -> Iterator[tuple[str, bytes]]:
    """(kind, payload) of results with the numbers from `first`: each has one hostile change, its number is sound."""
    draw = random.Random(seed)
    for number in range(first, first + count):
        result = draw.choice(kinds(number, sensor))
        fields = msgspec.json.decode(msgspec.json.encode(result)) | {"recorded": True}
        yield draw.choice((result.what, result.what, result.what, "invented")), _changed(draw, fields)


def messages(seed: int, count: int) -> Iterator[Sent]:
    """Messages under all keys, with any number, name and attachment."""
    draw = random.Random(seed)
    for what, payload in payloads(seed, count, 1):
        before = draw.choice((b"", b"0", b"7", b"-1", b"9" * 19, b"9" * 400, b"\xff", "٣".encode(), b"1\nsigned"))
        name = draw.choice((what, what, *NAMES))
        number = str(draw.choice((0, 1, 7, 2**63 - 1, 2**63, -1))).encode()
        yield Sent(
            draw.choice(("mems", *NAMES)), name, re.sub(rb'"sequence":\d+', b'"sequence":' + number, payload), before
        )


def _changed(draw: random.Random, fields: dict[str, Any]) -> bytes:
    leaf = draw.choice(LEAVES)
    within: Any = fields
    while True:
        keys = list(within) if isinstance(within, dict) else list(range(len(within)))
        key = draw.choice([key for key in keys if key not in ("sequence", "sensor")])
        if not isinstance(within[key], (dict, list)) or not within[key] or draw.random() < 0.3:
            break
        within = within[key]
    way = draw.randrange(6)
    if way == 0 and isinstance(within, dict):
        del within[key]
    elif way == 1:
        fields[draw.choice(ADDED)] = _MARK
    else:
        within[key] = _MARK
    data = msgspec.json.encode(fields).replace(f'"{_MARK}"'.encode(), leaf.encode())
    if way == 2:  # cut, or one byte changed
        at = draw.randrange(len(data))
        data = data[:at] + (bytes([draw.randrange(256)]) + data[at + 1 :] if draw.random() < 0.5 else b"")
    return data


def put_all(session: zenoh.Session, sent: Iterable[Sent]) -> None:
    """Messages of a stranger, except under names that no key can have."""
    for sensor, what, payload, attachment in sent:
        with suppress(zenoh.ZError):
            session.put(f"fieldcal/v1/site/gw/{sensor}/{what}", payload, attachment=attachment)
            session.put(f"fieldcal/v1/site/{what}/status", payload)
