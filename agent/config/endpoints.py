"""Endpoints of Zenoh, and what is wrong with one that would connect to nothing."""

from __future__ import annotations

import re

_OF_AN_ADDRESS = ("tcp", "udp", "tls", "quic", "quic_datagram", "ws")  # protocols whose endpoint names host and port
_PROTOCOLS = (*_OF_AN_ADDRESS, "serial", "unixsock-stream", "unixpipe", "vsock")  # that Zenoh 1.10 has
_LAST_PORT = 65535
_ADDRESS = re.compile(r"[^/?#]*[^/?#:]:(\d{1,5})(?:[?#].*)?")


def endpoint_fault(value: str) -> str:
    """What is wrong with an endpoint of Zenoh, and what to do; "" where nothing is.

    Zenoh itself takes an address without a port, and then connects to nothing and says nothing.
    """
    protocol, slash, address = value.partition("/")
    if slash and protocol.endswith(":"):
        return f"write {protocol.rstrip(':').lower()}/{address.strip('/')}: one slash stands behind the protocol"
    if not slash or not protocol or not address:
        return "an endpoint is a protocol, a slash and an address, as in tcp/192.0.2.1:7447"
    if protocol not in _PROTOCOLS:
        return f"Zenoh has no protocol {protocol[:20]!r}, but {', '.join(_PROTOCOLS)}"
    found = _ADDRESS.fullmatch(address)
    if protocol in _OF_AN_ADDRESS and (found is None or int(found[1]) > _LAST_PORT):
        return "the address is a host, a colon and a port of 65535 at most, as in tcp/192.0.2.1:7447"
    return ""
