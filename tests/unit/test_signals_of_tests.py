"""No test leaves signals ignored to the tests after it, nor to the processes that they start."""

from __future__ import annotations

import signal

from agent.cli.stopping import STOP_SIGNALS, stopped_by_signals
from agent.delivery.ending import StopRequest


def test_a_run_in_this_process_ignores_signals_when_it_has_ended() -> None:
    with stopped_by_signals():
        pass
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN


def test_a_program_in_this_process_is_told_of_signals() -> None:
    StopRequest.by_signals()
    assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL


def test_the_next_test_has_them_again() -> None:
    assert signal.set_wakeup_fd(-1) == -1
    assert signal.SIG_IGN not in {signal.getsignal(number) for number in STOP_SIGNALS if number != signal.SIGHUP}
