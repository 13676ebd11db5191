"""The process of an agent ends in bounded time, whatever the router does: tests with real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import zenoh

from agent.delivery.session import session_config
from tests.unit.zenoh_site import Site, router_process

_AGENT = """
import os, sys, time
from pathlib import Path
from agent.delivery.history import StoreError
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.delivery.session import session_config
from tests.unit.zenoh_site import record, wait_for
store = Store(Path(sys.argv[1]), 0)
publisher = Publisher("site", "gw", [sys.argv[2]], store)
publisher.start()
wait_for(lambda: publisher.state().connected)
store.commit([record(1)])
publisher.publish(record(1))
wait_for(lambda: store.published() == 1)
print("ready", flush=True)
sys.stdin.readline()
if sys.argv[3] == "raise":
    raise RuntimeError("an agent that fails")
bigs = [record(n, text="x" * 900_000) for n in range(2, 42)]  # the buffers of a link hold a few of them
store.commit(bigs)
for big in bigs:
    publisher.publish(big)
begin = time.monotonic()
closed = publisher.close()
print(time.monotonic() - begin, closed, store.published() < 41, flush=True)
os._exit(0)
"""


def agent_process(tmp_path: Path, endpoint: str, way: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", _AGENT, str(tmp_path), endpoint, way],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.slow
def test_the_interpreter_exits_though_the_publisher_was_never_closed(site: Site, tmp_path: Path) -> None:
    agent = agent_process(tmp_path, site.endpoint, "raise")
    _, faults = agent.communicate("\n", timeout=60)
    assert agent.returncode == 1
    assert "RuntimeError: an agent that fails" in faults


@pytest.mark.slow
def test_close_is_bounded_while_a_frozen_router_holds_a_put_up(tmp_path: Path) -> None:
    router = router_process("--listen", "tcp/127.0.0.1:0")
    assert router.stdout is not None
    endpoint = router.stdout.readline().split()[-1]
    try:
        with zenoh.open(session_config("client", connect=[endpoint])) as client:
            subscriber = client.declare_subscriber("fieldcal/v1/**", zenoh.handlers.RingChannel(10))
            agent = agent_process(tmp_path, endpoint, "close")
            os.kill(router.pid, signal.SIGSTOP)
            said, _ = agent.communicate("\n", timeout=60)
            took_s, closed, held_up = said.split()
            assert (closed, held_up) == ("False", "True")
            assert float(took_s) < 4.5  # it waits for 1.2 s; the put is held up for 5 s
            assert agent.returncode == 0
            router.kill()  # so that the client can close
            subscriber.undeclare()
    finally:
        router.kill()
        router.communicate()
