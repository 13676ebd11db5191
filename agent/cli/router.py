"""`fieldcal router`: runs a Zenoh router in one process, for tests and small sites."""

from __future__ import annotations

import resource
from pathlib import Path

import click
import zenoh

from agent.delivery.ending import StopRequest
from agent.delivery.router import DEFAULT_ENDPOINT, open_router
from agent.delivery.session import EndpointError, EndpointRefused, closed_in_time
from agent.terminal.text import say


@click.command(help="Run a Zenoh router, for tests and small sites. It prints its endpoint and runs until Ctrl-C.")
@click.option(
    "--listen", metavar="ENDPOINT", help=f"Where to listen; with port 0, any free port.  [default: {DEFAULT_ENDPOINT}]"
)
@click.option(
    "--config",
    "config_file",
    metavar="F",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A Zenoh configuration (JSON5), for TLS and access control.",
)
def router(listen: str | None, config_file: Path | None) -> int:
    """Serve until SIGINT or SIGTERM. Exit status: 2 invalid endpoint or configuration, 1 the port is in use."""
    _, files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))  # two for each client
    stop = StopRequest.by_signals()
    try:
        session, endpoints = open_router(listen, config_file)
    except EndpointError as error:
        say(f"fieldcal router: {error}", err=True)
        return 1 if isinstance(error, EndpointRefused) else 2
    # From now on Zenoh prints which clients it refuses, and why; RUST_LOG sets other levels (docs/security.md).
    zenoh.init_log_from_env_or("warn")
    with closed_in_time(session):
        say(f"router at {', '.join(endpoints)}")
        stop.wait()
    return 0
