"""Deletes recordings while nothing can be recorded, so that the deletion is said on the disk before anything is lost.

On a full disk the event Pruned has no place. Each recording is then renamed to `fieldcal-<number>.deleted`, its first
bytes are replaced by a statement of its deletion, and the file is cut behind it. None of this needs new space. The
statement is signed where recordings are signed: otherwise somebody who steals a recording could have the agent say that
it was deleted. The next recording repeats what was deleted, and then these files go.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from agent.recording.files import recordings, sync_directory
from agent.recording.pruned_ranges import Ranges, merged
from agent.recording.records import MAGIC
from agent.recording.retention import is_kept
from agent.recording.signed_text import LARGEST, SignedText, SignedTextError, values_of, written

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys
    from agent.recording.signing import Signer

_PURPOSE = "fieldcal deletion, version 1"
_NAME = re.compile(r"fieldcal-(\d{6,18})\.deleted")
_log = logging.getLogger(__name__)


def set_aside(directory: Path, first: int, last: int, gateway: str, signer: Signer | None) -> None:
    """Replace the recordings `first` to `last` by statements, except those that somebody reads. Raises OSError."""
    for number, path in recordings(directory):
        if first <= number <= last and not is_kept(path):
            text = written(_PURPOSE, {"gateway": gateway, "recording": str(number)})
            statement = (signer.sign(text) if signer is not None else SignedText(text, "", "")).json + b"\n"
            path = path.rename(path.with_name(f"fieldcal-{number:06d}.deleted"))
            sync_directory(directory)
            with open(path, "r+b", buffering=0) as file:
                file.write(statement)
                os.fsync(file.fileno())
                file.truncate(len(statement))
    _log.info("recordings %d to %d deleted while nothing can be recorded", first, last)


def finish(directory: Path) -> None:
    """Finish what a crash interrupted: cut files behind their statement, rename whole recordings back. Raises OSError.

    No other process may use the directory.
    """
    for number, path in _files(directory):
        with open(path, "r+b") as file:
            begin = file.read(LARGEST)
            if not begin.startswith(MAGIC):
                file.truncate(len(begin.partition(b"\n")[0]) + 1)
                continue
        path.rename(directory / f"fieldcal-{number:06d}.mcap")


def deleted(directory: Path, gateway: str, keys: KnownKeys | None) -> tuple[Ranges, list[str]]:
    """(numbers that statements here name as deleted, why the other statements are not believed). Raises OSError.

    A statement must be of this `gateway` and number. With `keys` it must be signed by one of the gateway's.
    """
    numbers, faults = [], []
    for number, path in _files(directory):
        with open(path, "rb") as file:
            fault = _fault(file.read(LARGEST), number, gateway, keys)
        if fault:
            faults.append(f"{path} does not show that retention deleted this recording: {fault}")
        else:
            numbers.append((number, number))
    return merged(numbers), faults


def highest_number(directory: Path) -> int:
    """The highest number of a statement; 0 where there is none. Raises OSError."""
    return max((number for number, _ in _files(directory)), default=0)


def remove_statements(directory: Path, ranges: Ranges) -> None:
    """Delete the statements about numbers in `ranges`, which a recording on the disk repeats. Raises OSError."""
    for number, path in _files(directory):
        if any(first <= number <= last for first, last in ranges):
            path.unlink(missing_ok=True)


def _fault(data: bytes, number: int, gateway: str, keys: KnownKeys | None) -> str:
    try:
        statement = SignedText.read(data.partition(b"\n")[0])
        of, what = values_of(statement.text, _PURPOSE, ["gateway", "recording"])
    except SignedTextError as error:
        return str(error)
    if (of, what) != (gateway, str(number)):
        return f"it is about recording {what!r:.20} of {of!r:.130}"
    return statement.fault_by(keys, gateway) if keys is not None else ""


def _files(directory: Path) -> Iterator[tuple[int, Path]]:
    for path in sorted(directory.iterdir()):
        if match := _NAME.fullmatch(path.name):
            yield int(match[1]), path
