"""Keeps the highest counter accepted of each key over restarts, so that no command is accepted twice."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec

from agent.config.files import read_file

LARGEST = 1 << 20  # bytes; a hundred keys take 10 kB
FILE_NAME = "command-counters.json"


class Counters:
    """The highest accepted counters, by key, in a file of a data directory.

    Counters are UTC in ns (agent.commanding.envelope). Where the file is missing or unreadable, only counters above the
    present time are accepted, so that a lost file does not let an old command pass.
    `set_aside`: new path of an unreadable file, which is renamed; None where there was none.
    """

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir / FILE_NAME
        self._taken: dict[str, int] = {}
        self._floor = 0
        self.set_aside: Path | None = None
        try:
            self._taken = msgspec.json.decode(read_file(self._path, LARGEST), type=dict[str, int])
        except FileNotFoundError:
            self._floor = time.time_ns()
        except (OSError, msgspec.DecodeError, ValueError, RecursionError):
            self._floor = time.time_ns()
            self.set_aside = self._path.with_name(f"{FILE_NAME}.corrupt-{self._floor}")
            self._path.rename(self.set_aside)

    def last(self, key_id: str) -> int:
        """The highest counter accepted of this key; a command must have a greater one."""
        return max(self._floor, self._taken.get(key_id, 0))

    def take(self, key_id: str, counter: int) -> None:
        """Write the counter; when this returns it survives a power cut. After an OSError the old counter holds."""
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
