"""Settings of operators' commands: whose commands are accepted, and which."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from agent.config.section import Name, Section

PUBLIC_KEY_BYTES = 32


class CommandKey(Section):
    """One operator's key and its rights."""

    id: Name
    # The 32 bytes of an Ed25519 public key in base64, as `fieldcal keys command` prints them. It is not secret.
    public_key: str
    verbs: Annotated[tuple[Literal["pose", "hold", "accept", "rollback"], ...], Field(min_length=1, max_length=4)]
    sensors: Annotated[tuple[Name | Literal["*"], ...], Field(min_length=1, max_length=100)]

    @field_validator("public_key")
    @classmethod
    def _is_key(cls, value: str) -> str:
        try:
            length = len(base64.b64decode(value, validate=True))
        except (binascii.Error, ValueError):
            raise ValueError("not base64; copy it from the output of `fieldcal keys command`") from None
        if length != PUBLIC_KEY_BYTES:
            raise ValueError(f"{length} bytes, but an Ed25519 public key has {PUBLIC_KEY_BYTES}")
        return value

    @property
    def public_bytes(self) -> bytes:
        """The 32 bytes of the public key."""
        return base64.b64decode(self.public_key)

    def may(self, verb: str, sensor: str) -> bool:
        """Whether this key has the right to send the command `verb` to `sensor`."""
        return verb in self.verbs and ("*" in self.sensors or sensor in self.sensors)


class Commands(Section):
    """Commands of operators. They are refused unless `enabled` is set."""

    enabled: bool = False
    keys: Annotated[tuple[CommandKey, ...], Field(max_length=100)] = ()
    revoked_keys: Annotated[
        Path | None, Field(description="list of keys (`fieldcal keys revoke`): commands of a revoked key are refused")
    ] = None

    @model_validator(mode="after")
    def _keys(self) -> Commands:
        if self.enabled and not self.keys:
            raise ValueError("enabled, but without keys no command can be accepted; add a section [[commands.keys]]")
        return self
