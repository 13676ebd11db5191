"""Two gateways with one name, as after a memory card was copied: told to the second one, to consumers, on the page."""

from __future__ import annotations

import shutil
import threading
import time
import uuid
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from agent.delivery import instances
from agent.delivery.consumer import Consumer
from agent.delivery.instances import Instances
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from tests.unit.zenoh_site import KEY, Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from agent.monitor.notices import FleetWatch
from agent.monitor.settings import Notices
from tests.unit.monitor_site import Served

TOGETHER_S = 0.2  # in place of 30 s


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "TOGETHER_S", TOGETHER_S)
    monkeypatch.setattr(instances, "SPREAD_S", 0.1)
    monkeypatch.setattr(instances, "LOOK_S", 0.1)


class Gateway:
    """The outgoing side of an agent on a memory card."""

    def __init__(self, site: Site, card: Path) -> None:
        self.store = Store(card)
        self.publisher = Publisher("site", "gw", [site.endpoint], self.store, instance=uuid.uuid4().hex)
        self.publisher.start()
        wait_for(lambda: self.publisher.state().connected)

    @property
    def fault(self) -> str:
        return self.publisher.state().fault

    def has_looked(self) -> bool:
        """Whether its own look for a second one, which ends where it is alone, is over."""
        looks = self.publisher._name_watch
        return looks.ident is not None and not looks.is_alive()

    def close(self) -> None:
        """May be called twice."""
        self.publisher.close()
        self.store.close()


def test_copies_that_are_on_the_bus_in_turns_are_told_and_a_restart_is_not(site: Site, tmp_path: Path) -> None:
    with closing(Store(tmp_path / "card")) as store:
        store.commit([record(store.last_sequence() + 1)])
    shutil.copytree(tmp_path / "card", tmp_path / "copy")
    with Served(site, tmp_path / "monitor") as served:

        def publish(card: str, run: str) -> int:
            gateway = Gateway(site, tmp_path / card)
            made = record(gateway.store.last_sequence() + 1, "status", run_id=run)
            gateway.store.commit([made])
            gateway.publisher.publish(made)
            wait_for(lambda: gateway.store.published() == made.sequence)
            gateway.close()
            return made.sequence

        def taken(sequence: int) -> bool:
            return sequence in served.database.last_sequence().values()

        def why() -> str:
            (row,) = served.fleet.gateways({})
            return str(row["why"])

        for run in ("one", "one again"):
            last = publish("card", run)
            wait_for(lambda last=last: taken(last))  # type: ignore[misc]
        assert "copies of one memory card" not in why()
        assert publish("copy", "another") < last  # its store has never heard of these numbers
        wait_for(lambda: "copies of one memory card" in why())
        assert "; runs one, another have given" in why()


@pytest.mark.slow
def test_a_copied_card_is_told_to_the_second_gateway_to_consumers_and_on_the_page(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(Store(tmp_path / "card")) as store:
        store.commit([record(store.last_sequence() + 1)])
    shutil.copytree(tmp_path / "card", tmp_path / "copy")
    with ExitStack() as opened:
        served = opened.enter_context(Served(site, tmp_path / "monitor"))
        watch = FleetWatch(served.fleet, Notices(), [])
        consumer = opened.enter_context(Consumer([site.endpoint]))
        threading.Thread(target=lambda: list(consumer), daemon=True).start()
        first = opened.enter_context(closing(Gateway(site, tmp_path / "card")))

        def told() -> list[tuple[int, str]]:
            return [(row["instances"], row["why"]) for row in served.ask("/api/fleet").json["gateways"]]

        def notices() -> list[str]:
            return [notice.text for notice in watch.update(time.monotonic(), datetime.now(UTC))]

        wait_for(lambda: told() == [(1, "")])
        version = served.fleet.version
        second = opened.enter_context(closing(Gateway(site, tmp_path / "copy")))
        wait_for(lambda: second.fault.startswith("2 gateways are on the bus as site/gw (runs "))
        wait_for(lambda: [len(found) for found in consumer.doubled.values()] == [2])
        [runs] = consumer.doubled.values()  # the log of each gateway says its own
        words = f"2 gateways are on the bus under this name (runs {runs[0][:12]}, {runs[1][:12]})"
        wait_for(lambda: told() == [(2, words)])
        assert (notices(), notices()) == (["more than one gateway is on the bus under this name"], [])
        first.close()
        wait_for(lambda: (second.fault, consumer.doubled, told()) == ("", {}, [(1, "")]))
        assert served.fleet.version >= version + 2  # pages that are open learn both
    logged = [one.getMessage() for one in caplog.records if "gateways are on the bus" in one.getMessage()]
    assert 3 <= len(logged) <= 4  # by the consumer, the monitor, and each gateway that looks


def test_a_restart_and_a_restored_card_are_no_second_gateway(site: Site, tmp_path: Path) -> None:
    with closing(Gateway(site, tmp_path / "card")):
        pass
    shutil.copytree(tmp_path / "card", tmp_path / "copy")
    now_s = 0.0
    with site.client() as session:
        watched = Instances(session, f"{KEY}/**", lambda: now_s)
        for card in ("card", "copy"):
            with closing(Gateway(site, tmp_path / card)) as gateway:
                wait_for(lambda: len(watched._since_s.get("site/gw", {})) == 1)
                now_s += 2 * TOGETHER_S
                watched.look()
                assert watched.doubled == {}
                wait_for(gateway.has_looked)
                assert gateway.fault == ""
        watched.close()


def test_the_token_of_a_killed_run_is_no_second_gateway_while_the_router_keeps_it(site: Site) -> None:
    now_s = 0.0
    with site.client() as killed, site.client() as again, site.client() as session:
        left = killed.liveliness().declare_token(f"{KEY}/alive/killed")
        there = again.liveliness().declare_token(f"{KEY}/alive/again")
        watched = Instances(session, f"{KEY}/**", lambda: now_s)
        wait_for(lambda: len(watched._since_s.get("site/gw", {})) == 2)
        watched.look()
        assert watched.doubled == {}
        left.undeclare()
        wait_for(lambda: len(watched._since_s["site/gw"]) == 1)
        now_s += TOGETHER_S
        watched.look()
        assert watched.doubled == {}
        watched.close()
        there.undeclare()


def test_invented_instances_are_bounded(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "GATEWAYS_MAX", 3)
    with site.client() as stranger, site.client() as session:
        watched = Instances(session, "fieldcal/v1/**")
        held = [
            stranger.liveliness().declare_token(f"fieldcal/v1/s/gw{k}/alive/{n}") for k in range(5) for n in range(20)
        ]
        held.append(stranger.liveliness().declare_token("fieldcal/v1/s/gw0/last"))
        # Which three they are follows from the order in which the router tells them.
        wait_for(lambda: [len(found) for found in watched._since_s.values()] == 3 * [instances.INSTANCES_MAX])
        wait_for(lambda: (watched.look(), set(watched.doubled))[1] == set(watched._since_s))  # type: ignore[func-returns-value]
        assert len(held) == 101
        watched.close()
