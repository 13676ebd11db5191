"""The key of the gateway whose store this is."""

from __future__ import annotations

from dataclasses import dataclass

from agent.config.known_keys import KnownKeys
from agent.recording.signing import Signer


@dataclass(frozen=True, slots=True)
class GatewayKey:
    """The key with which a gateway (`<site>/<gateway>`) signs. `known`: that key, and those that it had before."""

    gateway: str
    signer: Signer

    @property
    def known_keys(self) -> KnownKeys:
        """The keys whose signatures count."""
        return self.signer.known
