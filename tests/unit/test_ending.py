"""A program is told to stop, and ends after its exit handlers and before the interpreter is finalised."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

# Gets a message when the interpreter is finalised, in a thread that waits for it in Zenoh. The answer of the C library
# to that is the abort of the process: the thread cannot leave Zenoh.
WAITING = """
import sys, threading, time, types
import zenoh
from agent.delivery.session import session_config
from agent.delivery.ending import ProcessEnd
{ending}
session = zenoh.open(session_config("peer"))
subscriber = session.declare_subscriber("key", zenoh.handlers.FifoChannel(4))
class Finalised:
    def __del__(self, put=session.put, sleep=time.sleep):
        put("key", b"")
        sleep(1)  # so that the thread has time to come back from Zenoh
sys.modules["finalised"] = types.ModuleType("finalised")
sys.modules["finalised"].one = Finalised()
threading.Thread(target=lambda: list(subscriber), daemon=True).start()
print("done")
"""
# Ends in the way that is given, with the tools of an exit: a handler, a thread that is waited for, buffered output.
ENDS = """
import atexit, sys, threading, time
from agent.delivery.ending import ProcessEnd
ending = ProcessEnd()
atexit.register(print, "handler")
def last():
    time.sleep(0.2)
    print("thread")
threading.Thread(target=last).start()
{end}
"""


def ended(code: str, **streams: int) -> subprocess.CompletedProcess[str]:
    """A program with this code, at its end."""
    given: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    buffered = os.environ | {"PYTHONUNBUFFERED": ""}
    return subprocess.run([sys.executable, "-c", code], text=True, timeout=60, check=False, env=buffered, **given)


def test_a_thread_that_waits_in_zenoh_does_not_abort_the_process() -> None:
    with_ending = ended(WAITING.replace("{ending}", "ProcessEnd().status = 0"))
    assert (with_ending.returncode, with_ending.stdout, with_ending.stderr) == (0, "done\n", "")


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="there such a thread is stopped for ever instead")
def test_without_it_the_process_is_aborted() -> None:
    without = ended(WAITING.replace("{ending}", ""))
    assert (without.returncode, without.stdout) == (-6, "done\n")
    assert "exception not rethrown" in without.stderr


@pytest.mark.parametrize(
    ("end", "status"), [("ending.status = 3; sys.exit(3)", 3), ("ending.status = 0", 0), ("raise ValueError", 1)]
)
def test_status_and_all_that_belongs_to_an_exit(end: str, status: int) -> None:
    told = ended(ENDS.replace("{end}", end))
    assert (told.returncode, told.stdout) == (status, "thread\nhandler\n")
    assert ("Traceback" in told.stderr) == (status == 1)


@pytest.mark.parametrize(
    "waits", ["atexit.register(threading.Event().wait)", "threading.Thread(target=threading.Event().wait).start()"]
)
def test_what_waits_for_ever_ends_with_the_process(waits: str) -> None:
    told = ended(ENDS.replace("{end}", f"{waits}; ending.status = 0; ending.within(0.5)"))
    assert (told.returncode, told.stderr) == (0, "")


def test_a_signal_sets_a_stop_request_whatever_it_interrupts() -> None:
    """A signal comes at each call in `wait`: an event of `threading` would wait there for a lock of its own thread."""
    told = ended("""
import signal, sys
from agent.delivery.ending import StopRequest
stop = StopRequest.by_signals()
assert not stop.is_set()
sys.setprofile(lambda *_: signal.raise_signal(signal.SIGTERM))
waited = stop.wait(0.1)
sys.setprofile(None)
print(waited, stop.is_set(), stop.wait())
""")
    assert (told.returncode, told.stdout, told.stderr) == (0, "True True True\n", "")


def test_a_signal_stops_a_program_before_its_handler_has_run() -> None:
    """The main thread runs handlers between its calls; of a signal just before a call that waits, none is run."""
    told = ended("""
import signal
from agent.delivery.ending import StopRequest
for number in (signal.SIGINT, signal.SIGTERM):
    stop = StopRequest.by_signals()
    before = stop.is_set()
    signal.signal(number, lambda *_: None)  # in the place of the handler that would run too late
    signal.raise_signal(number)
    print(before, stop.is_set())
""")
    assert (told.returncode, told.stdout, told.stderr) == (0, "False True\nFalse True\n", "")


@pytest.mark.parametrize("raises", ["raise_every_interrupt()", ""])
def test_an_interrupt_reaches_a_call_that_waits_already(tmp_path: Path, raises: str) -> None:
    """A signal just before the call; here another thread takes it while the main thread waits, which is the same. By
    itself Python raises it when the call has ended."""
    told = ended(f"""
import os, signal, threading, time
from pathlib import Path
from agent.delivery.ending import raise_every_interrupt
{raises}
def waits(begun=threading.main_thread().native_id):
    return Path(f"/proc/self/task/{{begun}}/wchan").read_text() == "wait_for_partner"
def signals():
    while not waits():
        time.sleep(0.01)
    signal.pthread_kill(threading.get_ident(), signal.SIGINT)
    interrupted.wait({20.0 if raises else 0.0})
    print("ended", flush=True)
    os.open("{tmp_path}/pipe", os.O_RDONLY)
interrupted = threading.Event()
os.mkfifo("{tmp_path}/pipe")
threading.Thread(target=signals, daemon=True).start()
try:
    open("{tmp_path}/pipe", "w")  # until somebody reads
except KeyboardInterrupt:
    print("interrupted", flush=True)
    os._exit(0)
""")
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout == ("interrupted\n" if raises else "ended\ninterrupted\n")


@pytest.mark.parametrize("raises", ["raise_every_interrupt()", ""])
def test_an_interrupt_that_a_finaliser_discards_is_raised_anew(raises: str) -> None:
    told = ended(f"""
import signal, sys, threading
from agent.delivery.ending import raise_every_interrupt
{raises}
class Finalised:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
try:
    Finalised()
    threading.Event().wait({20.0 if raises else 0.0})
except KeyboardInterrupt:
    print("interrupted")
""")
    assert (told.returncode, told.stdout) == (0, "interrupted\n" if raises else "")
    assert ("KeyboardInterrupt" in told.stderr) == (not raises)


def test_output_that_cannot_be_written_is_no_success() -> None:
    with open("/dev/full", "w") as full:
        assert ended(ENDS.replace("{end}", "ending.status = 0"), stdout=full.fileno()).returncode == 1


def test_the_command_line_ends_so() -> None:
    code = """
import os, sys, types
class Finalised:
    def __del__(self, write=os.write):
        write(2, b"finalised")
sys.modules["finalised"] = types.ModuleType("finalised")
sys.modules["finalised"].one = Finalised()
{end}"""
    assert ended(code.replace("{end}", "")).stderr == "finalised"
    command = "sys.argv[1:] = ['--version']; from agent.__main__ import main; main()"
    said = ended(code.replace("{end}", command))
    assert (said.returncode, said.stderr) == (0, "")
    assert said.stdout.startswith("fieldcal")
