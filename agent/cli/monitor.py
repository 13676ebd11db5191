"""`fieldcal monitor`: the fleet page. It needs the extra `monitor` of the package."""

from __future__ import annotations

import ipaddress
import sqlite3
from contextlib import ExitStack, closing
from pathlib import Path

import click

from agent.cli.tls_options import tls_files, tls_options
from agent.config.key_file import KeyFileError
from agent.config.known_keys import read_known_keys
from agent.delivery.router import DEFAULT_ENDPOINT, open_router, router_running
from agent.delivery.session import EndpointError
from agent.terminal.text import say


@click.command()
@click.option("--connect", "endpoints", multiple=True, default=[DEFAULT_ENDPOINT], show_default=True,
              metavar="ENDPOINT", help="Router; may be given several times.")  # fmt: skip
@click.option("--listen", default="127.0.0.1:8460", show_default=True, metavar="HOST:PORT", help="Where the page is.")
@click.option("--router", "with_router", is_flag=True, help=f"Start a router at {DEFAULT_ENDPOINT} unless one runs.")
@click.option("--data-dir", type=click.Path(file_okay=False, path_type=Path), default=Path("monitor"),
              show_default=True, help="Where the database is kept.")  # fmt: skip
@click.option(
    "--keys",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="F",
    help="List of known keys; results that no key of their gateway signed are refused and counted.",
)
@click.option("--host", "names", multiple=True, metavar="NAME", help="Name by which browsers reach this server, "
              "besides localhost and IP addresses; may be given several times.")  # fmt: skip
@tls_options
def monitor(
    endpoints: tuple[str, ...],
    listen: str,
    with_router: bool,
    data_dir: Path,
    keys: Path | None,
    names: tuple[str, ...],
    ca: str | None,
    certificate: str | None,
    certificate_key: str | None,
) -> int:
    """Show all sensors of all gateways on one web page, until Ctrl-C. Exit status: 1 port or disk, 2 bad input."""
    try:
        import uvicorn

        from agent.monitor.server import application
    except ImportError:
        say("fieldcal monitor: the page needs starlette and uvicorn; install them with: "
            "fieldcal extras --install monitor", err=True)  # fmt: skip
        return 1
    from agent.monitor.database import Database
    from agent.monitor.fleet import Fleet
    from agent.monitor.following import Following

    host, port = _listen(listen)
    tls = tls_files(endpoints, ca, certificate, certificate_key)
    with ExitStack() as stack:
        try:
            if keys is not None:
                read_known_keys(keys)
            if with_router and not router_running(DEFAULT_ENDPOINT):
                stack.enter_context(open_router(None)[0])
            data_dir.mkdir(parents=True, exist_ok=True)
            database = stack.enter_context(closing(Database(data_dir / "monitor.sqlite")))
            fleet = Fleet()
            following = stack.enter_context(closing(Following(endpoints, tls, database, fleet, keys)))
        except (EndpointError, KeyFileError) as error:
            say(f"fieldcal monitor: {error}", err=True)
            return 2
        except sqlite3.Error as error:
            say(f"fieldcal monitor: {data_dir / 'monitor.sqlite'}: {error}", err=True)
            return 1
        say(f"the fleet page is at http://{listen}")
        if not _is_loopback(host):
            say("anyone who reaches this address can read the page: it has no login", err=True)
        app = application(database, fleet, following, names)
        uvicorn.run(app, host=host, port=port, log_level="warning", timeout_graceful_shutdown=1, server_header=False)
    return 0


def _listen(listen: str) -> tuple[str, int]:
    host, _, port = listen.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise click.BadParameter(f"{listen!r} is not HOST:PORT, such as 127.0.0.1:8460", param_hint="--listen")
    return host.strip("[]"), int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
