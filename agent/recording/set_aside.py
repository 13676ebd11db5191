"""Deletes recordings while nothing can be recorded, so that the deletion is said on the disk before anything is lost.

On a full disk the event Pruned has no place. Each recording is then renamed to `fieldcal-<number>.deleted`, its first
bytes are replaced by a statement of its deletion, and the file is cut behind it. None of this needs new space. The
statement is signed where recordings are signed: otherwise somebody who steals a recording could have the agent say that
it was deleted. It names the content of the recording, so that no statement about another recording can take its place.
The next recording repeats what was deleted, and then these files go.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.config.files import open_file
from agent.recording.files import recording_name, recordings, sync_directory
from agent.recording.pruned_ranges import Deleted, first_outside
from agent.recording.records import MAGIC
from agent.recording.retention import is_kept
from agent.recording.signed_text import LARGEST, SignedText, SignedTextError, count, values_of, written

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys
    from agent.recording.signing import Signer

_PURPOSE = "fieldcal deletion, version 2"
_LINES = ["gateway", "epoch", "recording", "previous", "sha256", "newest"]
_PURPOSE_1 = "fieldcal deletion, version 1"
_NAME = re.compile(r"fieldcal-(\d{6,18})\.deleted")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DeletionStatements:
    """The statements of a directory that count. `of_version_1`: they give the number only, so any recording can be
    meant. `faults`: why the others do not count.
    """

    deleted: tuple[Deleted, ...] = ()
    of_version_1: tuple[Deleted, ...] = ()
    faults: tuple[str, ...] = ()


def set_aside(directory: Path, deleted: Deleted, gateway: str, signer: Signer | None) -> None:
    """Replace a recording by a statement, except where somebody reads it. Raises OSError."""
    there = recordings(directory)
    for number, path in there:
        if number == deleted.last and not is_kept(path):
            values = {
                "gateway": gateway,
                "epoch": deleted.epoch or "-",
                "recording": str(number),
                "previous": deleted.previous_sha256 or "-",
                "sha256": deleted.sha256,
                "newest": str(there[-1][0]),
            }
            text = written(_PURPOSE, values)
            statement = (signer.sign(text) if signer is not None else SignedText(text, "", "")).json + b"\n"
            path = path.rename(_statement_path(directory, number))
            sync_directory(directory)
            with open(path, "r+b", buffering=0) as file:
                file.write(statement)
                os.fsync(file.fileno())
                file.truncate(len(statement))
            _log.info("recording %d deleted while nothing can be recorded", number)


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
        path.rename(directory / recording_name(number))


def statements(
    directory: Path, gateway: str, keys: KnownKeys | None, repeated: Sequence[Deleted]
) -> DeletionStatements:
    """The statements in a directory about recordings of a gateway. Raises OSError.

    `repeated`: what recordings say was deleted; statements about it are left out. With `keys` a statement must be
    signed by one of the gateway's.
    """
    newest = max((number for number, _ in recordings(directory)), default=0)
    found, of_version_1, faults = list[Deleted](), list[Deleted](), list[str]()
    for number, path in _files(directory):
        if first_outside(repeated, number, number) is None:
            continue
        with open_file(path) as file:
            data = file.read(LARGEST).partition(b"\n")[0]
        try:
            statement = SignedText.read(data)
            fault = statement.fault_by(keys, gateway) if keys is not None else ""
            if statement.text.startswith(_PURPOSE_1):
                _about(number, gateway, *values_of(statement.text, _PURPOSE_1, ["gateway", "recording"]))
                deleted, group = Deleted(number, number), of_version_1
            else:
                deleted, group = _read(statement.text, number, gateway, newest), found
        except SignedTextError as error:
            fault = str(error)
        if fault:
            faults.append(f"{path} does not show that retention deleted this recording: {fault}")
        else:
            group.append(deleted)
    return DeletionStatements(tuple(found), tuple(of_version_1), tuple(faults))


def highest_number(directory: Path) -> int:
    """The highest number of a statement; 0 where there is none. Raises OSError."""
    return max((number for number, _ in _files(directory)), default=0)


def remove_statements(directory: Path, entries: Sequence[Deleted]) -> None:
    """Delete the statements about numbers in `entries`, which a recording on the disk repeats. Raises OSError."""
    for number, path in _files(directory):
        if first_outside(entries, number, number) is None:
            path.unlink(missing_ok=True)


def _read(text: str, number: int, gateway: str, newest: int) -> Deleted:
    """What a statement says. `newest`: number of the newest recording here. Raises SignedTextError."""
    of, epoch, about, previous, sha256, at = values_of(text, _PURPOSE, _LINES)
    _about(number, gateway, of, about)
    if count(at) < newest:
        raise SignedTextError(f"it was made when recording {at} was the newest, and recording {newest} lacks it")
    deleted = Deleted.of_text(f"{number}-{number} {epoch} {previous} {sha256}")
    if deleted is None or not deleted.sha256:
        raise SignedTextError("its lines are not as this program writes them")
    return deleted


def _about(number: int, gateway: str, of: str, about: str) -> None:
    if (of, about) != (gateway, str(number)):
        raise SignedTextError(f"it is about recording {about!r:.20} of {of!r:.130}")


def _files(directory: Path) -> Iterator[tuple[int, Path]]:
    for path in sorted(directory.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match and path == _statement_path(directory, int(match[1])):
            yield int(match[1]), path


def _statement_path(directory: Path, number: int) -> Path:
    return (directory / recording_name(number)).with_suffix(".deleted")
