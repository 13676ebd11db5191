"""A gateway that signs its results, lists of known keys, and consumers that verify."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.core.events import Result
from agent.delivery.consumer import Consumer, Received
from agent.delivery.history import StoredResult
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.recording.result_signing import ResultSigner
from agent.recording.signing import Signer
from tests.attacks.chain_site import KEY
from tests.unit.results import calibration
from tests.unit.zenoh_site import Site, taken_until, wait_for

OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
PLACE = "fieldcal/v1/site/gw/mems/calibration"


def in_base64(key: Ed25519PrivateKey) -> str:
    return base64.b64encode(key.public_key().public_bytes_raw()).decode()


def listed(path: Path, *keys: Ed25519PrivateKey, gateway: str = "site/gw") -> Path:
    """A list in which these are the keys of a gateway."""
    path.write_text("".join(f"gateway {gateway} {in_base64(key)}\n" for key in keys))
    return path


def signer_of(gateway: str, epoch: str, key: Ed25519PrivateKey | None) -> ResultSigner:
    signer = ResultSigner(epoch, Signer(key) if key is not None else None)
    signer.gateway = gateway
    return signer


def signed_record(result: Result, signer: ResultSigner, epoch: str) -> StoredResult:
    """As the agent makes it of a result of event 7."""
    signed = signer.signed(7, result)
    return StoredResult.of(result, recorded=True, recording="f", epoch=epoch, signed=signed.data if signed else b"")


class Gateway:
    """The outgoing side of an agent with a key; without one where `key` is None."""

    def __init__(self, site: Site, directory: Path, key: Ed25519PrivateKey | None = KEY, name: str = "gw") -> None:
        self.name = f"site/{name}"
        self.store = Store(directory, 1000)
        self.signer = signer_of(self.name, self.store.epoch, key)
        self.publisher = Publisher("site", name, [site.endpoint], self.store)
        self.publisher.start()

    def make(self, **changes: Any) -> StoredResult:
        """The next calibration."""
        result = msgspec.structs.replace(calibration(self.store.last_sequence() + 1), **changes)
        return signed_record(result, self.signer, self.store.epoch)

    def send(self, count: int) -> list[int]:
        """Store and publish so many calibrations; returns their numbers."""
        numbers = []
        for _ in range(count):
            record = self.make()
            self.store.commit([record])
            self.publisher.publish(record)
            numbers.append(record.sequence)
        wait_for(lambda: self.store.published() == numbers[-1])
        return numbers

    def stop(self) -> None:
        self.publisher.close()
        self.store.close()


def taken(consumer: Consumer, last: int) -> list[Received]:
    """The results up to number `last`; what has come where it never comes."""
    return taken_until(consumer, lambda result: result.sequence >= last)


def numbers_of(results: Sequence[Received]) -> list[int]:
    return [result.sequence for result in results]
