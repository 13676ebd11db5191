"""Outages of router, gateway and consumer, with real processes: no result is lost, order is kept, nobody is blocked."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from agent.delivery import memory
from tests.scenarios.delivery_processes import CONSUMER, GATEWAY, Gateway, free_endpoint, numbers, process, router
from tests.scenarios.processes import wait_until

OUTAGE = 10_000  # results
FREEZE_S = 12.0  # Zenoh closes a link after 10 s without an answer


def follow(stack: ExitStack, endpoint: str, directory: Path) -> object:
    return stack.enter_context(process("-c", CONSUMER, endpoint, directory / "memory", directory / "received"))


@pytest.mark.slow
def test_ten_thousand_results_wait_for_a_router_that_was_killed(tmp_path: Path) -> None:
    endpoint, received = free_endpoint(), tmp_path / "received"
    with ExitStack() as stack:
        first = stack.enter_context(router(endpoint))
        gateway = Gateway(stack.enter_context(process("-c", GATEWAY, tmp_path, endpoint)))
        memory.save(tmp_path / "memory", {"site/gw": gateway.begin})
        follow(stack, endpoint, tmp_path)
        gateway.send(10)
        gateway.sent()
        wait_until(lambda: len(numbers(received)) == 10, 60, "the first results arrive")
        first.kill()
        first.wait()
        gateway.send(OUTAGE)
        last, longest_s, published = gateway.sent()
        assert published < gateway.begin + 200, "it did wait"
        assert longest_s < 2.0
        stack.enter_context(router(endpoint))
        wait_until(lambda: last in numbers(received)[-1:], 60, "all have arrived")
        assert numbers(received) == list(range(gateway.begin + 1, gateway.begin + 10 + OUTAGE + 1))


def published_by(gateway: Gateway) -> int:
    """The last number that the gateway takes for published."""
    gateway.send(0)
    return gateway.sent()[2]


@pytest.mark.slow
def test_a_frozen_router_holds_nobody_up_and_loses_nothing(tmp_path: Path) -> None:
    endpoint, received = free_endpoint(), tmp_path / "received"
    with ExitStack() as stack:
        frozen = stack.enter_context(router(endpoint))
        gateway = Gateway(stack.enter_context(process("-c", GATEWAY, tmp_path, endpoint)))
        memory.save(tmp_path / "memory", {"site/gw": gateway.begin})
        follow(stack, endpoint, tmp_path)
        gateway.send(10)
        gateway.sent()
        wait_until(lambda: len(numbers(received)) == 10, 60, "the first results arrive")
        wait_until(lambda: published_by(gateway) == gateway.begin + 10, 60, "the gateway knows that they are taken")
        os.kill(frozen.pid, signal.SIGSTOP)
        count = 1000
        gateway.send(count, size=20_000, pause_s=FREEZE_S / (count / 10))
        last, longest_s, published = gateway.sent()
        assert longest_s < 2.0  # a put waits for 5 s
        assert published == gateway.begin + 10, "what a frozen router has not taken is not published"
        os.kill(frozen.pid, signal.SIGCONT)
        gateway.send(10)
        last, _, _ = gateway.sent()
        wait_until(lambda: last in numbers(received)[-1:], 60, "all have arrived")
        assert numbers(received) == list(range(gateway.begin + 1, last + 1))


@pytest.mark.slow
def test_gateway_and_consumer_are_killed_again_and_again(tmp_path: Path) -> None:
    endpoint, received = free_endpoint(), tmp_path / "received"
    committed: set[int] = set()
    with ExitStack() as stack:
        stack.enter_context(router(endpoint))
        for turn in range(4):
            running = stack.enter_context(process("-c", GATEWAY, tmp_path, endpoint))
            gateway = Gateway(running)
            if turn == 0:
                memory.save(tmp_path / "memory", {"site/gw": gateway.begin})
            with ExitStack() as following:
                follow(following, endpoint, tmp_path)
                gateway.send(500, pause_s=0.01)
                last, _, _ = gateway.sent()
                committed |= set(range(gateway.begin + 1, last + 1))
                time.sleep(0.3 * turn)  # some of it published, some of it received
                if turn == 3:
                    wait_until(lambda n=last: n in numbers(received)[-1:], 60, "all have arrived")
            running.kill()
            running.wait()
    got = numbers(received)
    assert set(got) == committed
    assert [n for k, n in enumerate(got) if n not in got[:k]] == sorted(committed), "in order but for what came again"
