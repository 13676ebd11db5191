"""`fieldcal monitor`: the fleet page. It needs the extra `monitor` of the package."""

from __future__ import annotations

import ipaddress
import socket
import sqlite3
import ssl
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from agent.cli.tls_options import TlsOptions, tls_options
from agent.config.key_file import KeyFileError, read_private_key
from agent.config.known_keys import read_known_keys
from agent.config.reading import ConfigError
from agent.delivery.router import DEFAULT_ENDPOINT, open_router, router_running
from agent.delivery.session import EndpointError, closed_in_time
from agent.monitor.rights import RIGHTS
from agent.terminal.text import say

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_NEEDS = "fieldcal monitor: the page needs the extra monitor; install it with: fieldcal extras --install monitor"


_OPTIONS: list[Callable[[Callable[..., Any]], Callable[..., Any]]] = [
    click.option("--connect", "endpoints", multiple=True, default=[DEFAULT_ENDPOINT], show_default=True,
                 metavar="ENDPOINT", help="Router; may be given several times."),
    click.option("--listen", default="127.0.0.1:8460", show_default=True, metavar="HOST:PORT",
                 help="Where the page is."),
    click.option("--router", "with_router", is_flag=True,
                 help=f"Start a router at {DEFAULT_ENDPOINT} unless one runs."),
    click.option("--data-dir", type=click.Path(file_okay=False, path_type=Path), default=Path("monitor"),
                 show_default=True, help="Where the database is kept."),
    click.option("--keys", type=_FILE, metavar="F",
                 help="List of known keys; results that no key of their gateway signed are refused and counted."),
    click.option("--host", "names", multiple=True, metavar="NAME", help="Name by which browsers reach this server, "
                 "besides localhost and IP addresses; may be given several times."),
    click.option("--users", type=click.Path(dir_okay=False, path_type=Path), metavar="F",
                 help="File of users: the page then needs a login."),
    click.option("--add-user", metavar="NAME", help="Add a user to the file --users, or replace one, and end. Asks for "
                 "the password, or reads it from the standard input."),
    click.option("--verb", "verbs", multiple=True, type=click.Choice(RIGHTS),
                 help="With --add-user: a command that the page forwards for this user, or `plan`: the user may change "
                 "the plan; may be given several times."),
    click.option("--config", "config_file", type=_FILE, metavar="F",
                 help="Plan of the structure, and who gets notices (TOML)."),
    click.option("--https-certificate", type=_FILE, metavar="F",
                 help="Certificate of the web server (PEM), for HTTPS."),
    click.option("--https-key", type=_FILE, metavar="F", help="Private key of --https-certificate (PEM)."),
    click.option("--behind-proxy", is_flag=True, help="A web server on this machine does HTTPS and passes requests on: "
                 "believe its X-Forwarded-For and X-Forwarded-Proto."),
    click.option("--command-certificate", type=click.Path(exists=True, dir_okay=False), metavar="F",
                 help="Certificate of a commander (PEM) for the router, see `fieldcal keys`; default: --certificate."),
    click.option("--command-key", type=click.Path(exists=True, dir_okay=False), metavar="F",
                 help="Private key of --command-certificate (PEM)."),
    tls_options,
]  # fmt: skip


def _options(command: Callable[..., Any]) -> Callable[..., Any]:
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


@click.command()
@_options
def monitor(
    endpoints: tuple[str, ...],
    listen: str,
    with_router: bool,
    data_dir: Path,
    keys: Path | None,
    names: tuple[str, ...],
    users: Path | None,
    add_user: str | None,
    verbs: tuple[str, ...],
    config_file: Path | None,
    https_certificate: Path | None,
    https_key: Path | None,
    behind_proxy: bool,
    command_certificate: str | None,
    command_key: str | None,
    tls: TlsOptions,
) -> int:
    """Show all sensors of all gateways on one web page, until Ctrl-C. Exit status: 1 port or disk, 2 bad input."""
    try:
        from agent.monitor.engines import DatabaseError
        from agent.monitor.running import BusAccess, Web, serve
        from agent.monitor.settings import MonitorSettings, load_settings
        from agent.monitor.users import UsersError
    except ImportError:
        say(_NEEDS, err=True)
        return 1
    if add_user is not None:
        return _add_user(users, add_user, verbs)
    host, port = _listen(listen)
    _check_https(host, users, https_certificate, https_key, behind_proxy)
    commander = TlsOptions(tls.ca, command_certificate or tls.certificate, command_key or tls.certificate_key)
    bus = BusAccess(endpoints=endpoints, tls=tls.files(endpoints), commander=commander.files(endpoints), keys=keys)
    web = Web(names=names, users=users, certificate=https_certificate, key=https_key, behind_proxy=behind_proxy)
    with ExitStack() as stack:
        try:
            if keys is not None:
                read_known_keys(keys)
            settings = load_settings(config_file) if config_file is not None else MonitorSettings()
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listening = stack.enter_context(socket.create_server((host, port), family=family))
            if with_router and not router_running(DEFAULT_ENDPOINT):
                stack.enter_context(closed_in_time(open_router(None)[0]))
            data_dir.mkdir(parents=True, exist_ok=True)
            _say_address(
                listen, https=https_certificate is not None, open_to_all=users is None and not _is_loopback(host)
            )
            serve(listening, data_dir, bus, web, settings)
        except (ConfigError, EndpointError, KeyFileError, UsersError) as error:
            say(f"fieldcal monitor: {error}", err=True)
            return 2
        except DatabaseError as error:
            say(f"fieldcal monitor: {error}", err=True)
            return 1
        except (sqlite3.Error, OSError) as error:
            where = listen if isinstance(error, OSError) else data_dir / "monitor.sqlite"
            say(f"fieldcal monitor: {where}: {error}", err=True)
            return 1
    return 0


def _say_address(listen: str, *, https: bool, open_to_all: bool) -> None:
    say(f"the fleet page is at http{'s' if https else ''}://{listen}")
    if open_to_all:
        say("anyone who reaches this address can read the page: it has no login (option --users)", err=True)


def _add_user(users: Path | None, name: str, verbs: tuple[str, ...]) -> int:
    from agent.monitor.users import UsersError, set_user

    if users is None:
        raise click.UsageError("--add-user needs --users, the file to which the user is added")
    if sys.stdin.isatty():
        password = click.prompt(f"password of {name}", hide_input=True, confirmation_prompt=True)
    else:
        password = sys.stdin.readline().rstrip("\n")
    try:
        set_user(users, name, verbs, password)
    except UsersError as error:
        say(f"fieldcal monitor: {error}", err=True)
        return 2
    say(f"{users}: {name} may read{''.join(f', {verb}' for verb in verbs)}")
    return 0


def _check_https(host: str, users: Path | None, certificate: Path | None, key: Path | None, behind_proxy: bool) -> None:
    if users is not None and not (certificate or behind_proxy or _is_loopback(host)):
        raise click.UsageError(
            "--users on an address that is not loopback needs HTTPS, because passwords could be read on the way; "
            "give --https-certificate and --https-key, or --behind-proxy"
        )
    if (certificate is None) != (key is None):
        raise click.UsageError("--https-certificate and --https-key must be given together")
    if certificate is None or key is None:
        return
    try:
        read_private_key(key)
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(certificate, key)
    except KeyFileError as error:
        raise click.UsageError(str(error)) from None
    except (OSError, ssl.SSLError):
        raise click.UsageError(f"{certificate}: not a certificate in PEM of the key {key}") from None


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
