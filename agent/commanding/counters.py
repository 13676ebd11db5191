"""The highest counter taken of each key, kept over restarts: a command that was seen once is none any more."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec

FILE_NAME = "command-counters.json"


class Counters:
    """Counters of the keys in a file of a data directory.

    Counters are UTC in ns (agent.commanding.envelope), so where the file is missing or cannot be read nothing from
    before this moment is taken: a lost file opens no way for an old command. `set_aside` names an unreadable one.
    """

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir / FILE_NAME
        self._taken: dict[str, int] = {}
        self._floor = 0
        self.set_aside: Path | None = None
        try:
            self._taken = msgspec.json.decode(self._path.read_bytes(), type=dict[str, int])
        except FileNotFoundError:
            self._floor = time.time_ns()
        except (msgspec.DecodeError, ValueError, RecursionError):
            self._floor = time.time_ns()
            self.set_aside = self._path.with_name(f"{FILE_NAME}.corrupt-{self._floor}")
            self._path.rename(self.set_aside)

    def last(self, key_id: str) -> int:
        """A command of this key must have a greater counter."""
        return max(self._floor, self._taken.get(key_id, 0))

    def take(self, key_id: str, counter: int) -> None:
        """Keep the counter; when this returns it survives a power cut. Raises OSError, and nothing is taken."""
        taken = self._taken | {key_id: counter}
        draft = self._path.with_suffix(".new")
        with open(draft, "wb") as file:
            file.write(msgspec.json.encode(taken))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self._path)
        directory = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
        self._taken = taken
