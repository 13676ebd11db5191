"""Zenoh keys of this project: `fieldcal/v1/<site>/<gateway>[/<sensor>]/<what>`."""

from __future__ import annotations

import re
from dataclasses import dataclass

PREFIX = "fieldcal/v1"
# ASCII, no wildcard, no '@' at the front (Zenoh matches '@' chunks only verbatim), nothing that needs quoting.
CHUNK = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def gateway_key(site: str, gateway: str) -> str:
    """`fieldcal/v1/<site>/<gateway>`, under which all of a gateway lives. Raises ValueError on a bad name."""
    for name in (site, gateway):
        if not CHUNK.fullmatch(name):
            raise ValueError(f"{name!r} cannot be part of a Zenoh key: 1 to 63 ASCII letters, digits, '-', '_', '.'")
    return f"{PREFIX}/{site}/{gateway}"


def result_key(gateway: str, sensor: str, what: str) -> str:
    """Key of a result under the gateway's own key; an empty `sensor` means the gateway itself."""
    return f"{gateway}/{sensor}/{what}" if sensor else f"{gateway}/{what}"


@dataclass(frozen=True, slots=True)
class Address:
    """A key taken apart. `sensor` is empty where the gateway itself speaks."""

    site: str
    gateway: str
    sensor: str
    what: str

    @property
    def source(self) -> str:
        """`<site>/<gateway>`: who counts the sequence."""
        return f"{self.site}/{self.gateway}"


def parse_key(key: str) -> Address | None:
    """Take the key of a result apart; None where it is not one."""
    chunks = key.split("/")
    if "/".join(chunks[:2]) != PREFIX or len(chunks) not in (5, 6):
        return None
    return Address(chunks[2], chunks[3], chunks[4] if len(chunks) == 6 else "", chunks[-1])


def narrow(key: str, source: str) -> str:
    """The key expression `key` restricted to one gateway, `<site>/<gateway>`; it must match that gateway at all."""
    rest = key.removeprefix(PREFIX + "/").split("/")
    named = 0
    while named < 2 and rest and rest[0] != "**":
        rest, named = rest[1:], named + 1
    return "/".join([PREFIX, source, *rest])
