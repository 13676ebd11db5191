"""The base class of all sections of a configuration, and types of names and vectors."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_OF_AN_ADDRESS = ("tcp", "udp", "tls", "quic", "quic_datagram", "ws")  # protocols whose endpoint names host and port
_PROTOCOLS = (*_OF_AN_ADDRESS, "serial", "unixsock-stream", "unixpipe", "vsock")  # that Zenoh 1.10 has
_LAST_PORT = 65535
_ADDRESS = re.compile(r"[^/?#]*[^/?#:]:(\d{1,5})(?:[?#].*)?")


def _name(value: str) -> str:
    if not _NAME.fullmatch(value):
        raise ValueError(
            "a name has 1 to 63 letters (A-Z, a-z), digits, '_', '.' or '-', the first a letter or a digit"
        )
    return value


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


def _endpoint(value: str) -> str:
    if fault := endpoint_fault(value):
        raise ValueError(fault)
    return value


Name = Annotated[str, AfterValidator(_name), Field(description="a chunk of a Zenoh key")]
Endpoint = Annotated[str, AfterValidator(_endpoint), Field(description="of a Zenoh router: tcp/192.0.2.1:7447")]
Vector = tuple[float, float, float]


class Section(BaseModel):
    """Base of all sections: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
