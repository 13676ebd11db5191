"""`fieldcal router`: a Zenoh router in one process, for tests and small sites."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import click
import zenoh

from agent.delivery.router import DEFAULT_ENDPOINT, open_router
from agent.delivery.session import EndpointError, EndpointRefused


@click.command(help="A Zenoh router, for tests and small sites. Prints its endpoint and runs until it is interrupted.")
@click.option(
    "--listen", metavar="ENDPOINT", help=f"Where to listen; port 0 takes a free one.  [default: {DEFAULT_ENDPOINT}]"
)
@click.option(
    "--config",
    "config_file",
    metavar="F",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A Zenoh configuration (JSON5), for TLS and access control.",
)
def router(listen: str | None, config_file: Path | None) -> int:
    """Serve until SIGINT or SIGTERM. Exit status 2 for what is no endpoint or configuration, 1 for a taken port."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        session, endpoints = open_router(listen, config_file)
    except EndpointError as error:
        click.echo(f"fieldcal router: {error}", err=True)
        return 1 if isinstance(error, EndpointRefused) else 2
    # From now on who is not let in, and why, is in our output; RUST_LOG asks for more (docs/security.md).
    zenoh.init_log_from_env_or("warn")
    click.echo(f"router at {', '.join(endpoints)}")
    stop.wait()
    session.close()
    return 0
