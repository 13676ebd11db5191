"""Zenoh keys of this project: `fieldcal/v1/<site>/<gateway>[/<sensor>]/<what>`."""

from __future__ import annotations

import re
from dataclasses import dataclass

PREFIX = "fieldcal/v1"
# ASCII, no wildcard, no '@' at the front (wildcards do not match a part that begins with '@'), no quoting needed.
CHUNK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def gateway_key(site: str, gateway: str) -> str:
    """`fieldcal/v1/<site>/<gateway>`, with which all keys of a gateway begin. Raises ValueError for an invalid name."""
    for name in (site, gateway):
        if not CHUNK.fullmatch(name):
            raise ValueError(
                f"{name!r} cannot be part of a Zenoh key; use 1 to 63 ASCII letters, digits, '-', '_' and '.'"
            )
    return f"{PREFIX}/{site}/{gateway}"


def result_key(gateway: str, sensor: str, what: str) -> str:
    """Key of a result of `sensor` under the key `gateway`; an empty `sensor` means a result of the gateway itself."""
    return f"{gateway}/{sensor}/{what}" if sensor else f"{gateway}/{what}"


@dataclass(frozen=True, slots=True)
class Address:
    """The parts of a key. `sensor` is empty where the key belongs to the gateway itself."""

    site: str
    gateway: str
    sensor: str
    what: str

    @property
    def source(self) -> str:
        """`<site>/<gateway>`; each gateway counts its own sequence."""
        return f"{self.site}/{self.gateway}"

    @property
    def is_result(self) -> bool:
        """Whether results are published here. The gateway's own messages and the corrected stream are none."""
        return bool(self.sensor) and self.what != "acceleration"


def parse_key(key: str) -> Address | None:
    """Split the key of a result into its parts; None where it is not such a key."""
    chunks = key.split("/")
    if "/".join(chunks[:2]) != PREFIX or len(chunks) not in (5, 6):
        return None
    return Address(chunks[2], chunks[3], chunks[4] if len(chunks) == 6 else "", chunks[-1])


def narrow(key: str, source: str) -> str:
    """The key expression `key` restricted to one gateway, `<site>/<gateway>`; `key` must match that gateway."""
    rest = key.removeprefix(PREFIX + "/").split("/")
    named = 0
    while named < 2 and rest and rest[0] != "**":
        rest, named = rest[1:], named + 1
    return "/".join([PREFIX, source, *rest])


def presence_key(key: str) -> str:
    """The keys of the liveliness tokens of the gateways that the key expression `key` may match."""
    gateway = key.removeprefix(PREFIX + "/").split("/")[:2]
    named = gateway[: gateway.index("**")] if "**" in gateway else gateway
    return "/".join([PREFIX, *named, *["*"] * (2 - len(named)), "alive"])
