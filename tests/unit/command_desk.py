"""A desk with one operator, and the bytes that this operator, or another, would send to it."""

from __future__ import annotations

import time
from base64 import b64encode
from pathlib import Path
from typing import Any

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from agent.commanding.desk import Answer, CommandDesk
from agent.commanding.envelope import Order, seal
from agent.config import Commands
from agent.core.events import Command
from agent.delivery.history import FILE_NAME, History, StoredResult
from agent.delivery.store import Store
from tests.unit.zenoh_site import record

GATEWAY = "workshop/gateway-1"
# Keys from fixed bytes: the same in every run.
ANNA = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
RIGHTS = ("pose", "hold", "rollback")  # of anna, for the sensor mems alone


def settings(*, enabled: bool = True, **more: Any) -> Commands:
    """Commands of anna, who may do RIGHTS with mems."""
    public = b64encode(ANNA.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)).decode()
    key = {"id": "anna", "public_key": public, "verbs": RIGHTS, "sensors": ["mems"]}
    return Commands.model_validate({"enabled": enabled, "keys": [key], **more})


class DeskSite:
    """A desk in a data directory, and what it told of."""

    def __init__(self, directory: Path, **more: Any) -> None:
        self.directory = directory
        self.events: list[Command] = []
        store = directory / FILE_NAME
        if not store.exists():
            made = Store(directory, count_from=100)
            made.commit([record(101, "calibration"), record(102, "window")])
            made.close()

        def find(sensor: str, what: str, sequence: int) -> StoredResult | None:
            with History(store) as history:
                found = history.after(sequence - 1, [(sensor, what)], limit=1)
            return found[0] if found and found[0].sequence == sequence else None

        self.desk = CommandDesk(GATEWAY, ["mems", "spare"], settings(**more), directory, find, self.events.append)

    def send(self, data: bytes, sensor: str = "mems", verb: str = "hold") -> Answer:
        """The answer to bytes on the address of a sensor and a verb."""
        return self.desk.receive(f"{sensor}/command/{verb}", data)


def signed(body: bytes) -> bytes:
    """Any bytes with anna's signature, put together as docs/security.md says."""
    signature = b64encode(ANNA.sign(b"fieldcal-command-1 anna\n" + body))
    return b"fieldcal-command-1 anna " + signature + b"\n" + body


def sealed(
    arguments: dict[str, Any] | bytes | None = None,
    *,
    sensor: str = "mems",
    verb: str = "hold",
    gateway: str = GATEWAY,
    key_id: str = "anna",
    key: Ed25519PrivateKey = ANNA,
    counter: int | None = None,
    valid_s: float = 60.0,
) -> bytes:
    """A command as bytes: good, but for what is said otherwise."""
    now_ns = time.time_ns()
    raw = arguments if isinstance(arguments, bytes) else msgspec.json.encode(arguments or {})
    order = Order(
        gateway=gateway,
        sensor=sensor,
        verb=verb,  # type: ignore[arg-type]
        arguments=msgspec.Raw(raw),
        counter=now_ns if counter is None else counter,
        expires_utc_ns=now_ns + int(valid_s * 1e9),
    )
    return seal(order, key_id, key)
