"""A simulated fleet in several processes, because a process of Python slows down with the number of its threads."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from time import monotonic, sleep
from typing import Any, NamedTuple, TypeVar

from agent.delivery.ending import ProcessEnd, StopRequest
from agent.delivery.session import session_config
from agent.fleet.simulated import FleetPlan, SimulatedFleet
from agent.fleet.simulated_sensor import Behaviour
from agent.fleet.workers import begin

# Gateways in one process, with two threads each that wake up 15 times a second. docs/fleet-evidence.md: what more cost.
GATEWAYS_EACH = 100
LEAVE_S = 3.0  # to end in order, once they are to stop; then what is left is killed: a router sees its gateways leave
ENDED_S = 1.0  # to learn how a process has ended
NICE = 10  # gateways are other machines: simulated ones leave the processor to a router and a monitor on this one

SPAWN = multiprocessing.get_context("spawn")  # Zenoh does not work in a forked process

_part: SimulatedFleet  # in a process of the fleet: its gateways
_stop: StopRequest  # and whether they are to stop
Value = TypeVar("Value")


class NamedGateway(NamedTuple):
    """A gateway of the fleet. `source`: `<site>/<gateway>`; `public_key`: of its signatures, 32 bytes."""

    name: str
    source: str
    behaviour: Behaviour
    public_key: bytes


class ProcessEnded(Exception):  # noqa: N818 - what has happened
    """A process of the fleet has ended though it was not to. The message says by which signal or status."""


class FleetProcesses(AbstractContextManager["FleetProcesses"]):
    """Gateways as planned, in processes of at most GATEWAYS_EACH, which open one by one.

    `unconnected`: the number of gateways that found no router. The processes end with this process, and LEAVE_S after
    they are to stop. Raises EndpointError, StoreError, ProcessEnded; the methods raise ProcessEnded.
    """

    def __init__(self, plan: FleetPlan, stop: StopRequest | None = None) -> None:
        """`stop`: once it is set, what is going on ends soon."""
        session_config("client", connect=plan.connect)  # raises EndpointError here rather than in another process
        parts = -(-plan.gateways // GATEWAYS_EACH)
        self.gateways: list[NamedGateway] = []
        self.unconnected = 0
        self._parts: list[ProcessPoolExecutor] = []
        self._stop = stop or StopRequest()
        self._left = threading.Event()  # all processes have ended
        threading.Thread(target=self._end_in_time, name="end", daemon=True).start()
        with ExitStack() as opened:
            opened.callback(self._left.set)
            for part in range(parts):
                process = opened.enter_context(
                    ProcessPoolExecutor(1, mp_context=SPAWN, initializer=_begin, initargs=(self._stop,))
                )
                numbers = range(part, plan.gateways, parts)
                with _without_interrupts():
                    opening = process.submit(_open, plan, numbers)
                self._processes = multiprocessing.active_children()
                with self._telling_ends():
                    gateways, unconnected = opening.result()
                opened.callback(_leave, process)
                self._parts.append(process)
                self.gateways += gateways
                self.unconnected += unconnected
            self._opened = opened.pop_all()

    def step(self, t_utc_ns: int, within_s: float = 0.0) -> int:
        """As SimulatedFleet.step, in each process."""
        return sum(self._in_each_process(_step, t_utc_ns, within_s))

    def last_sequence(self) -> dict[str, int]:
        """The number of the last result of each gateway, by its name."""
        return {name: last for part in self._in_each_process(_last_sequence) for name, last in part.items()}

    def truth(self) -> list[dict[str, Any]]:
        """What is true of each gateway and its sensors now, by the names of the gateways."""
        return sorted(
            (gateway for part in self._in_each_process(_truth) for gateway in part), key=lambda told: told["gateway"]
        )

    def pids(self) -> list[int]:
        """Of its processes."""
        return self._in_each_process(os.getpid)

    def names_of(self, behaviour: Behaviour) -> list[str]:
        """The gateways that behave so."""
        return sorted(gateway.name for gateway in self.gateways if gateway.behaviour == behaviour)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for process in self._parts:  # all at the same time; _leave then waits for each
            with suppress(BrokenProcessPool):
                process.submit(_close)
        self._opened.close()

    def _end_in_time(self) -> None:
        self._stop.wait()
        if not self._left.wait(LEAVE_S):
            for process in multiprocessing.active_children():
                process.kill()

    def _in_each_process(self, what: Callable[..., Value], *arguments: Any) -> list[Value]:
        """What the function gives in each process, where they run at the same time."""
        with self._telling_ends():
            return [future.result() for future in [part.submit(what, *arguments) for part in self._parts]]

    @contextmanager
    def _telling_ends(self) -> Iterator[None]:
        try:
            yield
        except BrokenProcessPool:
            codes: list[int] = []
            end = monotonic() + ENDED_S
            while not codes and monotonic() < end:  # the thread of a pool may be about to learn it
                sleep(0.01)
                codes = [code for process in self._processes if (code := process.exitcode) is not None]
            raise ProcessEnded("; ".join(map(_ended_by, codes)) or "a process of the fleet ended") from None


def _ended_by(code: int) -> str:
    if code >= 0:
        return f"a process of the fleet ended with status {code}"
    name = signal.Signals(-code).name
    why = ", as Linux does where there is too little memory" if -code == signal.SIGKILL else ""
    return f"a process of the fleet was ended by {name}{why}"


def _leave(process: ProcessPoolExecutor) -> None:
    with suppress(BrokenProcessPool):  # it has ended
        process.submit(_close).result()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """A process that is begun here does not take Ctrl-C of the terminal: it could not answer it before `_begin`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(stop: StopRequest) -> None:
    global _stop
    _stop = stop
    ProcessEnd().status = 0
    begin()
    os.nice(NICE)


def _open(plan: FleetPlan, numbers: Sequence[int]) -> tuple[list[NamedGateway], int]:
    global _part
    _part = SimulatedFleet(plan, numbers, _stop)
    return [NamedGateway(g.name, g.source, g.behaviour, g.public_key) for g in _part.gateways], _part.unconnected


def _step(t_utc_ns: int, within_s: float) -> int:
    return _part.step(t_utc_ns, within_s)


def _last_sequence() -> dict[str, int]:
    return {gateway.name: gateway.last_sequence for gateway in _part.gateways}


def _truth() -> list[dict[str, Any]]:
    return [gateway.truth() for gateway in _part.gateways]


def _close() -> None:
    _part.__exit__()
