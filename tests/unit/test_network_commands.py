"""Commands as Zenoh queries, through a session of this process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from agent.commanding.network import serve_queries
from agent.delivery.keys import gateway_key
from agent.delivery.session import session_config
from tests.unit.command_desk import DeskSite, sealed

KEY = gateway_key("workshop", "gateway-1")


@pytest.fixture
def site(tmp_path: Path) -> DeskSite:
    return DeskSite(tmp_path)


@pytest.fixture
def session(site: DeskSite) -> Iterator[zenoh.Session]:
    with ExitStack() as open_things:
        session = open_things.enter_context(zenoh.open(session_config("peer")))
        serve_queries(session, KEY, site.desk, open_things)
        yield session


def ask(session: zenoh.Session, key: str, payload: bytes | None) -> list[object]:
    replies = session.get(key, payload=payload, consolidation=zenoh.ConsolidationMode.NONE, timeout=5.0)
    return [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok is not None]


def test_a_command_is_answered_on_its_own_key(site: DeskSite, session: zenoh.Session) -> None:
    data = sealed()
    assert ask(session, f"{KEY}/mems/command/hold", data) == [{"taken": True, "reason": ""}]
    (again,) = ask(session, f"{KEY}/mems/command/hold", data)
    assert isinstance(again, dict)
    assert not again["taken"]
    (other,) = ask(session, f"{KEY}/mems/command/pose", sealed())
    assert "hold for 'mems' was sent to mems/command/pose" in str(other)
    assert [event.verb for event in site.events] == ["hold", "hold", "pose"]


def test_no_bytes_are_no_command(site: DeskSite, session: zenoh.Session) -> None:
    assert len(ask(session, f"{KEY}/mems/command/hold", None)) == 1
    assert site.desk.counts() == {"unsigned": 1}


@pytest.mark.parametrize("key", [f"{KEY}/**", f"{KEY}/*/command/*", f"{KEY}/mems/command/*", "fieldcal/v1/**"])
def test_who_asks_for_everything_commands_nothing(site: DeskSite, session: zenoh.Session, key: str) -> None:
    assert ask(session, key, sealed()) == []
    assert (site.desk.counts(), site.events) == ({}, [])
