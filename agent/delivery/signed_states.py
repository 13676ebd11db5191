"""The signed list of the states of the estimation in the store: which ones are the newest, and their digests.

The list is signed with the gateway's key (docs/audit.md gives its layout). A state that is not in it, or has another
digest, is not one that the gateway kept.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from agent.core.memory import Memory
from agent.recording.signed_text import SignedText, SignedTextError, count, values_of, written

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

LARGEST = 1 << 20  # bytes of a list with its signature; a device takes about 200
_PURPOSE = "fieldcal states, version 1"
_NAMES = ["gateway", "epoch", "recording", "sequence", "states"]
_UNREADABLE = "the list of its states cannot be read"

Digests = dict[tuple[str, str], tuple[int, str]]  # (sequence, SHA-256 of the state) by sensor and identity


def digest_of(memory: Memory) -> tuple[int, str]:
    """What the list says of a state."""
    return memory.sequence, hashlib.sha256(memory.state).hexdigest()


def gateway_of(data: bytes) -> str:
    """The gateway that a signed list names. Raises SignedTextError where it is none."""
    return values_of(SignedText.read(data, LARGEST).text, _PURPOSE, _NAMES)[0]


@dataclass(frozen=True, slots=True)
class StateList:
    """The states that a gateway keeps for later runs.

    `epoch`: of the store. `recording`: the highest number of a recording, and `sequence` that of a result, when the
    list was made. `digests`: of all states.
    """

    gateway: str
    epoch: str
    recording: int
    sequence: int
    digests: Digests

    @property
    def text(self) -> str:
        """The bytes that are signed. Raises ValueError for a name of several lines."""
        rows = [[*device, *told] for device, told in sorted(self.digests.items())]
        states = msgspec.json.encode(rows).decode()
        values = (self.gateway, self.epoch, str(self.recording), str(self.sequence), states)
        return written(_PURPOSE, dict(zip(_NAMES, values, strict=True)))

    @staticmethod
    def read(data: bytes, gateway: str, keys: KnownKeys) -> StateList:
        """The list in signed bytes. Raises SignedTextError where no key in `keys` signed them for this gateway."""
        signed = SignedText.read(data, LARGEST)
        of, epoch, recording, sequence, states = values_of(signed.text, _PURPOSE, _NAMES)
        if fault := signed.fault_by(keys, gateway):
            raise SignedTextError(fault)
        if of != gateway:
            raise SignedTextError(f"it is of the gateway {of!r:.130}")
        try:
            rows = msgspec.json.decode(states, type=list[tuple[str, str, int, str]])
        except (msgspec.DecodeError, ValueError) as error:
            raise SignedTextError(f"{_UNREADABLE}: {error}") from None
        digests: Digests = {(sensor, identity): (number, sha256) for sensor, identity, number, sha256 in rows}
        return StateList(of, epoch, count(recording), count(sequence), digests)

    def fault(self, memories: Iterable[Memory]) -> str:
        """Why these are not the states in the list; "" where they are."""
        found = {(memory.sensor, memory.identity): digest_of(memory) for memory in memories}
        for device in sorted(found.keys() | self.digests.keys()):
            if found.get(device) != self.digests.get(device):
                there = "is missing" if device not in found else "is not the one that the gateway signed"
                return f"the state of {device[0]!r:.70} ({device[1]!r:.130}) {there}"
        return ""
