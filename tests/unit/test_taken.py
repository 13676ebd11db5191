"""Up to which result the routers have taken what was put, with a real router that answers, freezes and is killed."""

from __future__ import annotations

import signal

import psutil
import zenoh

from agent.delivery.session import closed_in_time, session_config
from agent.delivery.taken import Taken
from tests.unit.zenoh_site import router_process, wait_for


def test_only_what_a_router_answers_for_on_the_same_link_is_taken() -> None:
    router = router_process("--listen", "tcp/127.0.0.1:0")
    assert router.stdout is not None
    endpoint = next(word for word in router.stdout.readline().split() if word.startswith("tcp/"))
    try:
        with closed_in_time(zenoh.open(session_config("client", connect=[endpoint]))) as session:
            taken = Taken()
            taken.begin(session)
            assert taken.links_changed()
            assert not taken.links_changed()
            assert taken.up_to(5) == 0, "the router is asked, and has not answered yet"
            answers: list[int] = []

            def asked(last: int) -> int:
                answers.append(taken.up_to(last))
                return answers[-1]

            wait_for(lambda: asked(6) == 6)
            assert sorted(set(answers) - {0}) == [5, 6], "each number is asked for in turn"
            router.send_signal(signal.SIGSTOP)
            wait_for(lambda: psutil.Process(router.pid).status() == psutil.STATUS_STOPPED)
            assert taken.up_to(9) == 0
            router.kill()  # Zenoh now ends the question as if it was answered
            answers.clear()
            wait_for(lambda: asked(9) > 0 or not session.info.links())
            answers += [taken.up_to(9) for _ in range(100)]
            assert set(answers) == {0}
            assert taken.links_changed()
    finally:
        router.kill()
        router.communicate()
