"""Keeps the highest counter accepted of each key over restarts, so that no command is accepted twice."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec

from agent.config.files import read_file

LARGEST = 1 << 20  # bytes; a hundred keys take 10 kB
FILE_NAME = "command-counters.json"
EVERY_KEY = "*"  # its counter in the file holds for all keys; no key has this identifier


class Counters:
    """The highest accepted counters, by key, in a file of a data directory.

    Counters are UTC in ns (agent.commanding.envelope). Where the file is missing or unreadable, for example after a
    backup was restored, only commands that are signed after the start are accepted, so that no old command passes. The
    first command that is taken writes this limit too, for the keys that were not used yet. A clock that is set while
    the agent runs moves the limit, never to an earlier time.
    `set_aside`: new path of an unreadable file, which is renamed; None where there was none.
    """

    def __init__(self, data_dir: Path) -> None:
        self._path = data_dir / FILE_NAME
        self._taken: dict[str, int] = {}
        self._began_ns: int | None = None  # CLOCK_MONOTONIC of a start without counters
        self.set_aside: Path | None = None
        try:
            self._taken = msgspec.json.decode(read_file(self._path, LARGEST), type=dict[str, int])
        except FileNotFoundError:
            self._begin_anew()
        except (OSError, msgspec.DecodeError, ValueError, RecursionError):
            self._begin_anew()
            self.set_aside = self._path.with_name(f"{FILE_NAME}.corrupt-{time.time_ns()}")
            self._path.rename(self.set_aside)

    def last(self, key_id: str) -> int:
        """The highest counter accepted of this key; a command must have a greater one."""
        if self._began_ns is not None:
            began_utc_ns = time.time_ns() - (time.monotonic_ns() - self._began_ns)
            self._taken[EVERY_KEY] = max(self._taken[EVERY_KEY], began_utc_ns)
        return max(self._taken.get(EVERY_KEY, 0), self._taken.get(key_id, 0))

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

    def _begin_anew(self) -> None:
        self._began_ns = time.monotonic_ns()
        self._taken = {EVERY_KEY: time.time_ns()}
