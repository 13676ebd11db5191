"""How every Zenoh session is configured and closed: without search for peers, with named endpoints, in limited time."""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import zenoh

from agent.config.endpoints import endpoint_fault
from agent.config.key_file import KeyFileError, read_private_key
from agent.config.tls import TlsFiles

# Bytes. A block of corrected acceleration at 10 kHz takes a fifth of this; Zenoh's default limit is 1 GiB.
LARGEST_MESSAGE = 1 << 20
# Clients of a router. Zenoh refuses number 1,001 by default. A client takes 2 open files of the router.
ROUTER_SESSIONS = 10_000
ROUTER_ACCEPTS = 1000  # clients that may be connecting at the same time: all gateways of a site after an outage
ROUTER_ACCEPT_S = 30.0  # for one of them to connect; Zenoh's 10 s may end in the middle (agent.delivery.hearing)

# s between two attempts to reach a router again: drawn for the first, twice as long after each, at most the last one.
# 1,000 gateways that all came at once would keep a router busy for so long that connections time out.
RETRY_FIRST_S, RETRY_LONGEST_S = (0.5, 1.5), 10.0
CLOSE_S = 1.0  # s that closing may take; it takes some milliseconds where Zenoh waits for nobody


class EndpointError(Exception):
    """Zenoh cannot use an endpoint. The message names the endpoint or the file."""


class EndpointRefused(EndpointError):  # noqa: N818 - the endpoint itself is valid
    """A valid endpoint that this machine cannot listen at: the port is in use, or the address is not its own."""


def session_config(
    mode: Literal["peer", "client", "router"],
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    tls: TlsFiles | None = None,
    one_of_many: bool = False,
) -> zenoh.Config:
    """A Zenoh configuration that uses only the given endpoints; with `tls`, both sides of a link show certificates.

    `one_of_many`: sessions that lose their router at the same moment come back one after the other.
    Raises EndpointError where a given endpoint is not valid, or another user may read the private key.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # scouting is off; the default would delay opening by half a second
        # Off: it makes two files of 16 MiB in /dev/shm, which stay after a kill, and the payloads here never need it.
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": LARGEST_MESSAGE,
        "transport/link/tls": _tls(tls),
    }.items():
        config.insert_json5(key, json.dumps(value))
    if one_of_many:
        retry = {"period_init_ms": round(1000 * random.uniform(*RETRY_FIRST_S)), "period_increase_factor": 2.0,
                 "period_max_ms": round(1000 * RETRY_LONGEST_S)}  # fmt: skip
        config.insert_json5("connect/retry", json.dumps(retry))
    if mode == "router":
        config.insert_json5("transport/unicast/max_sessions", json.dumps(ROUTER_SESSIONS))
        config.insert_json5("transport/unicast/accept_pending", json.dumps(ROUTER_ACCEPTS))
        config.insert_json5("transport/unicast/accept_timeout", json.dumps(int(ROUTER_ACCEPT_S * 1000)))
    for endpoint in (*connect, *listen):
        if fault := endpoint_fault(endpoint):
            raise EndpointError(f"not an endpoint: {endpoint}: {fault}")
    for key, endpoints in (("connect/endpoints", connect), ("listen/endpoints", listen)):
        try:
            config.insert_json5(key, json.dumps(list(endpoints)))
        except zenoh.ZError:
            shown = ", ".join(endpoints)
            raise EndpointError(f"not an endpoint such as tcp/192.0.2.1:7447: {shown}") from None
    return config


@contextmanager
def closed_in_time(session: zenoh.Session, within_s: float = CLOSE_S) -> Iterator[zenoh.Session]:
    """Context of a session, which is closed at the end of the context, as by `close_in_time`."""
    try:
        yield session
    finally:
        close_in_time(session.close, within_s)


def close_in_time(close: Callable[[], object], within_s: float = CLOSE_S) -> None:
    """Call `close`, which closes a session or what is declared in it, and return after `within_s` at the latest.

    Zenoh 1.10 waits for each connection that is being set up. Where the other side says nothing, a router closes after
    10 s and with an error, and sometimes never (Zenoh issues 2675 and 969). Then a thread goes on closing, which ends
    with the process at the latest (agent.delivery.ending).
    """

    def closing() -> None:
        with suppress(zenoh.ZError):  # that it took too long
            close()

    thread = threading.Thread(target=closing, name="close", daemon=True)
    thread.start()
    thread.join(within_s)


def check_private_key(path: Path) -> None:
    """Raise EndpointError where a private key is not its owner's alone. Zenoh itself reports a file that is missing."""
    if not path.exists():
        return
    try:
        read_private_key(path)
    except KeyFileError as error:
        raise EndpointError(str(error)) from None


def _tls(files: TlsFiles | None) -> dict[str, object]:
    if files is None:
        return {}
    check_private_key(Path(files.key))
    return {
        "root_ca_certificate": files.ca,
        "connect_certificate": files.certificate,
        "connect_private_key": files.key,
        "enable_mtls": True,  # without it this side would not show its certificate
        "verify_name_on_connect": True,
    }
