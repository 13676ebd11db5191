"""Who may command the agent, and what."""

from __future__ import annotations

import base64
import binascii
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from agent.config.section import Name, Section

PUBLIC_KEY_BYTES = 32


class CommandKey(Section):
    """One operator's key and its rights."""

    id: Name
    # As `fieldcal keys command` prints it: Ed25519, the 32 bytes in base64. It is no secret.
    public_key: str
    verbs: Annotated[tuple[Literal["pose", "hold", "accept", "rollback"], ...], Field(min_length=1, max_length=4)]
    sensors: Annotated[tuple[Name | Literal["*"], ...], Field(min_length=1, max_length=100)]

    @field_validator("public_key")
    @classmethod
    def _is_key(cls, value: str) -> str:
        try:
            length = len(base64.b64decode(value, validate=True))
        except (binascii.Error, ValueError):
            raise ValueError("not base64") from None
        if length != PUBLIC_KEY_BYTES:
            raise ValueError(f"{length} bytes, an Ed25519 public key has {PUBLIC_KEY_BYTES}")
        return value

    @property
    def public_bytes(self) -> bytes:
        """The key itself."""
        return base64.b64decode(self.public_key)

    def may(self, verb: str, sensor: str) -> bool:
        """Whether this key has the right."""
        return verb in self.verbs and ("*" in self.sensors or sensor in self.sensors)


class Commands(Section):
    """Commands of operators. Off, unless this says otherwise."""

    enabled: bool = False
    keys: Annotated[tuple[CommandKey, ...], Field(max_length=100)] = ()

    @model_validator(mode="after")
    def _keys(self) -> Commands:
        if self.enabled and not self.keys:
            raise ValueError("enabled without keys: nobody could command")
        return self
