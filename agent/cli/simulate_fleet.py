"""`fieldcal simulate --fleet`: many gateways on the bus, until Ctrl-C."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from agent.config.whole_files import write_whole
from agent.delivery.ending import StopRequest
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.fleet.simulated import StopEvent
    from agent.fleet.simulated_processes import FleetProcesses

FILES_PER_GATEWAY = 10  # open files: the store with its readers, and Zenoh; measured in docs/fleet-evidence.md
ROUTER_S = 30.0  # s to wait for a router
STEP_S = 0.5
DAY_S = 86400.0
NAMES_SHOWN = 5


def fleet_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a simulated fleet."""
    for option in (
        click.option("--keys", type=click.Path(dir_okay=False, path_type=Path), metavar="F",
                     help="Fleet: add the gateways' public keys to this list of known keys."),
        click.option("--truth", type=click.Path(dir_okay=False, path_type=Path), metavar="F",
                     help="Fleet: write what is true of each sensor into this file (JSON), after each round."),
        click.option("--age", "age_days", type=click.FloatRange(0, 3650), default=0.0, show_default=True,
                     metavar="DAYS", help="Fleet: how long ago the first results were made."),
        click.option("--speed", type=click.FloatRange(1, 1e6), default=1.0, show_default=True,
                     help="Fleet: its time runs so much faster, until it has reached the present."),
        click.option("--every", "every_s", type=click.FloatRange(0.1, 86400), default=60.0, show_default=True,
                     metavar="S", help="Fleet: time between two results of a sensor."),
        click.option("--sensors", type=click.IntRange(1, 100), default=4, show_default=True,
                     help="Fleet: sensors of each gateway."),
        click.option("--connect", metavar="ENDPOINT", help="Fleet: the router.  [default: tcp/127.0.0.1:7447]"),
        click.option("--fleet", type=click.IntRange(1, 10_000), metavar="N", help="Act as N gateways on the bus."),
    ):  # fmt: skip
        command = option(command)
    return command


@dataclass(frozen=True, kw_only=True)
class FleetOptions:
    """The values of the options: so many gateways, `fleet`, with so many `sensors` each."""

    fleet: int
    connect: str | None
    sensors: int
    every_s: float
    speed: float
    age_days: float
    keys: Path | None
    truth: Path | None


def serve_fleet(options: FleetOptions, seed: int, duration_s: float | None) -> int:
    """Act as many gateways, whose results have the time that runs `speed` times faster from `age_days` ago.

    Until Ctrl-C, or for `duration_s`. Returns the exit status: 1 without router or with too few files, 2 bad endpoint.
    """
    from agent.config.key_file import KeyFileError
    from agent.config.known_keys import add_key
    from agent.delivery.router import DEFAULT_ENDPOINT
    from agent.delivery.session import EndpointError
    from agent.fleet.simulated import FleetPlan
    from agent.fleet.simulated_processes import GATEWAYS_EACH, FleetProcesses, ProcessEnded

    fleet, sensors, keys = options.fleet, options.sensors, options.keys
    endpoint, stop = options.connect or DEFAULT_ENDPOINT, StopRequest.by_signals()
    try:
        if fault := _files_fault(min(fleet, GATEWAYS_EACH)) or _router_fault(endpoint, stop):
            say(f"fieldcal simulate: {fault}", err=True)
            return 1
        with TemporaryDirectory(prefix="fieldcal-fleet-") as directory:
            with FleetProcesses(FleetPlan(fleet, sensors, seed, [endpoint], Path(directory)), stop) as simulated:
                if simulated.unconnected:
                    say(f"fieldcal simulate: {simulated.unconnected} gateways found no router yet", err=True)
                if keys is not None:
                    for gateway in simulated.gateways:
                        add_key(keys, gateway.source, gateway.public_key)
                say(f"{fleet} gateways with {sensors} sensors each at {endpoint}, seed {seed}")
                _say_odd(simulated)
                step = _step_of(simulated, stop, options.truth, seed)
                try:
                    results = _run(step, stop, options, duration_s)
                except ProcessEnded as ended:  # the end of the fleet, below, sets `stop`
                    say(f"fieldcal simulate: {ended}", err=True)
                    return 1
            say(f"{results} results sent")
    except ProcessEnded as ended:
        if not stop.is_set():
            say(f"fieldcal simulate: {ended}", err=True)
            return 1
    except (EndpointError, KeyFileError, OSError) as error:
        say(f"fieldcal simulate: {error}", err=True)
        return 2
    return 0


def _say_odd(simulated: FleetProcesses) -> None:
    from agent.fleet.simulated import ODD

    for behaviour in ODD:
        names = simulated.names_of(behaviour)
        more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
        say(f"{behaviour}: {', '.join(names[:NAMES_SHOWN]) or 'none'}{more}")


def _step_of(simulated: FleetProcesses, stop: StopEvent, truth: Path | None, seed: int) -> Callable[[int], int]:
    """One round of all gateways, after which `truth` is written; it gives the number of results.

    It raises ProcessEnded where a process has ended though it was not to stop.
    """
    from agent.fleet.simulated_processes import ProcessEnded

    def step(t_utc_ns: int) -> int:
        try:
            made = simulated.step(t_utc_ns)
            if truth is not None:
                told = {"seed": seed, "t_utc_ns": t_utc_ns, "gateways": simulated.truth()}
                write_whole(truth, json.dumps(told).encode())  # a reader never has half of it
        except ProcessEnded:
            if not stop.is_set():
                raise
            return 0  # a process has not ended this round in time
        return made

    return step


def _run(step: Callable[[int], int], stop: StopEvent, options: FleetOptions, duration_s: float | None) -> int:
    """Step until it is to stop; returns the number of results."""
    begun, results, rounds = time.monotonic(), 0, 0
    first_utc_ns = time.time_ns() - round(options.age_days * DAY_S * 1e9)
    while not stop.is_set():
        passed_s = time.monotonic() - begun
        if duration_s is not None and passed_s > duration_s:
            break
        results += step(min(first_utc_ns + round(passed_s * options.speed * 1e9), time.time_ns()))
        rounds += 1
        stop.wait(max(0.0, begun + rounds * options.every_s - time.monotonic()))
    return results


def _files_fault(gateways: int) -> str:
    """Allow as many open files as a process with so many gateways needs; why that cannot be, "" if it can."""
    needed, (soft, hard) = 256 + FILES_PER_GATEWAY * gateways, resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and needed > hard:
        return f"{gateways} gateways need {needed} open files, and this system allows {hard}; set `ulimit -Hn {needed}`"
    if soft != resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, needed), hard))
    return ""


def _router_fault(endpoint: str, stop: StopEvent) -> str:
    """Wait for the router; why there is none, "" if there is one. Raises EndpointError."""
    from agent.delivery.router import router_running

    end = time.monotonic() + ROUTER_S
    while not router_running(endpoint):
        if time.monotonic() > end or stop.wait(STEP_S):
            return f"no router answers at {endpoint}; start one with `fieldcal router` or `fieldcal monitor --router`"
    return ""
