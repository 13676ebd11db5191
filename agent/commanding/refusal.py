"""Why a command is refused: a kind, which is counted, and the words for whoever sent it."""

from __future__ import annotations

from typing import Literal

Kind = Literal[
    "too large", "unsigned", "unknown key", "bad signature", "malformed", "other gateway", "no such sensor",
    "no right", "expired", "replayed", "out of limits", "too many", "not kept",
]  # fmt: skip


class Refused(Exception):  # noqa: N818 - an answer, no error of the program
    """A command that is not taken. `str` says why, with the numbers."""

    def __init__(self, kind: Kind, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind
