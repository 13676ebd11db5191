"""The refusal of a command: a kind, which is counted, and a reason for the sender."""

from __future__ import annotations

from typing import Literal

Kind = Literal[
    "too large", "unsigned", "unknown key", "revoked key", "bad signature", "malformed", "other gateway",
    "no such sensor", "no right", "expired", "replayed", "out of limits", "too many", "not kept",
]  # fmt: skip


class Refused(Exception):  # noqa: N818 - an answer to the sender, not an error of the program
    """A command is refused. `str` gives the reason with its values."""

    def __init__(self, kind: Kind, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
