"""How a Zenoh session of this project is set: nothing found by multicast or gossip, nothing opened to the network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal

import zenoh

from agent.config.tls import TlsFiles

# Bytes. A block of corrected accelerations at 10 kHz has a fifth of it; Zenoh's own limit is a GiB.
LARGEST_MESSAGE = 1 << 20


class EndpointError(Exception):
    """An endpoint that Zenoh cannot use. The message names it."""


class EndpointRefused(EndpointError):  # noqa: N818 - said of a sound endpoint
    """The machine does not serve an endpoint that is one: its port is taken, its address is another's."""


def session_config(
    mode: Literal["peer", "client", "router"],
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    tls: TlsFiles | None = None,
) -> zenoh.Config:
    """A configuration with explicit end points only; with `tls` both sides of a link show who they are.

    Raises EndpointError where one is not an endpoint.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # nothing is scouted for: by default opening waits half a second
        # Two files of 16 MiB in /dev/shm, left behind by a kill, for payloads that are never that large.
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": LARGEST_MESSAGE,
        "transport/link/tls": _tls(tls),
    }.items():
        config.insert_json5(key, json.dumps(value))
    for key, endpoints in (("connect/endpoints", connect), ("listen/endpoints", listen)):
        try:
            config.insert_json5(key, json.dumps(list(endpoints)))
        except zenoh.ZError:
            shown = ", ".join(endpoints)
            raise EndpointError(f"not an endpoint such as tcp/192.0.2.1:7447: {shown}") from None
    return config


def _tls(files: TlsFiles | None) -> dict[str, object]:
    if files is None:
        return {}
    return {
        "root_ca_certificate": files.ca,
        "connect_certificate": files.certificate,
        "connect_private_key": files.key,
        "enable_mtls": True,  # without it we would not show our own certificate
        "verify_name_on_connect": True,
    }
