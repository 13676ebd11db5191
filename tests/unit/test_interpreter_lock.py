"""Threads of Zenoh and of Python never wait for each other's locks: the whole process would stand still for ever.

A thread of Zenoh that needs the lock of the interpreter (GIL) may hold a lock of its session. So no thread of the
program may hold the first while it waits for the second. Each program here keeps the lock of the interpreter from
before Zenoh's answer on, so that the order of the locks does not depend on chance.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.zenoh_site import Site

END_S = 60.0  # a program here takes a second

_HOLD = """
import os, sys, time
import zenoh
from pathlib import Path
from agent.delivery import hearing
from agent.delivery.publication import Publisher
from agent.delivery.session import session_config
from agent.delivery.store import Store
from tests.unit.zenoh_site import wait_for

def hold_the_interpreter():
    sys.setswitchinterval(100.0)
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        pass
"""

_HEARING = """
hearing.ASK_S = 0.0
session = zenoh.open(session_config("client", connect=[sys.argv[1]]))
question = hearing.Hearing()
question.begin(session)
assert not question.lost()
hold_the_interpreter()
session.is_closed()  # takes the session's lock, and keeps the interpreter's
sys.setswitchinterval(0.005)
wait_for(lambda: not question.lost() and question._question is None)
print("ended", flush=True)
os._exit(0)
"""

_PUBLISHER = """
def ask_and_hold(self):
    if publisher.state().published < 1:
        return False
    callback = zenoh.handlers.Callback(lambda reply: None, lambda: None, indirect=False)
    self._session.liveliness().get(hearing.NOBODY, callback)
    hold_the_interpreter()
    return True  # closes the session, and so undeclares the publishers, at once

from tests.unit.zenoh_site import record
hearing.Hearing.lost = ask_and_hold
store = Store(Path(sys.argv[2]), 0)
publisher = Publisher("site", "gw", [sys.argv[1]], store)
publisher.start()
store.commit([record(1)])
publisher.publish(record(1))
wait_for(lambda: sys.getswitchinterval() > 1.0)
sys.setswitchinterval(0.005)
print(publisher.close(60.0), flush=True)
os._exit(0)
"""


def printed(program: str, *arguments: object) -> str:
    """What the program prints. A program that stands still fails."""
    command = [sys.executable, "-c", _HOLD + program, *map(str, arguments)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=END_S, check=True).stdout


@pytest.mark.slow
def test_no_thread_of_zenoh_waits_for_the_interpreter_while_a_router_answers(site: Site) -> None:
    assert printed(_HEARING, site.endpoint) == "ended\n"


@pytest.mark.thorough
def test_publishers_are_undeclared_without_the_lock_of_the_interpreter(site: Site, tmp_path: Path) -> None:
    assert printed(_PUBLISHER, site.endpoint, tmp_path) == "True\n"
