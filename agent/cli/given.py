"""What `fieldcal audit` is given: recordings, or a data directory with its store and heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from agent.delivery.history import FILE_NAME, History
from agent.recording.end_check import GivenHead, when
from agent.recording.files import recordings
from agent.recording.head import HEAD_NAME, Head
from agent.recording.reading import first_event, open_recording
from agent.recording.signed_text import LARGEST, SignedText, SignedTextError
from agent.recording.signing import load_public_key
from agent.recording.witness import PUBLIC_NAME, SUFFIX, HeadFile, WitnessError


@dataclass(frozen=True, slots=True)
class GivenFiles:
    """Recordings to audit. `up_to`: for a whole directory, the highest file number; none up to it may be missing.

    `directory`: this directory. `heads`: heads that the recordings must reach. `faults`: what is
    wrong with the files of a witness.
    """

    paths: Sequence[Path]
    up_to: int | None = None
    directory: Path | None = None
    heads: list[GivenHead] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def recordings_of(paths: Sequence[Path]) -> GivenFiles:
    """The given files, or all recordings of a single given directory. Raises StoreError."""
    if len(paths) != 1 or not paths[0].is_dir():
        return GivenFiles(paths)
    files = recordings(paths[0])
    store, head = paths[0] / FILE_NAME, paths[0] / HEAD_NAME
    highest = files[-1][0] if files else 0
    if store.exists():
        with History(store) as history:
            highest = max(highest, history.file_sequence())
    heads = [GivenHead(str(head), _begin_of(head), elsewhere=False)] if head.exists() else []
    return GivenFiles([path for _, path in files], highest, paths[0], heads)


def read_head(path: Path) -> GivenHead:
    """A head from a file. Raises SignedTextError where the file holds none, OSError where it cannot be read."""
    data = _begin_of(path)
    try:
        Head.of(SignedText.read(data))
    except SignedTextError as error:
        raise SignedTextError(f"{path}: not a head of recordings: {error}") from None
    return GivenHead(str(path), data, elsewhere=True)


def add_witnessed(given: GivenFiles, directory: Path) -> None:
    """Add the newest head of each recording that a witness kept of the recordings' gateway; or what is wrong with them.

    Raises WitnessError where it kept none, KeyFileError, OSError.
    """
    start = next((start for start in map(first_event, given.paths) if start is not None), None)
    gateway = f"{start.site}/{start.gateway}" if start is not None else ""
    path = directory / f"{gateway}{SUFFIX}"
    if not gateway or not path.is_file():
        raise WitnessError(f"{directory}: this witness kept no heads of the gateway {gateway or 'of these recordings'}")
    key = load_public_key(directory / PUBLIC_NAME)
    try:
        kept = HeadFile(path, key)
    except WitnessError as error:
        given.faults.append(str(error))
        return
    given.faults.extend(f"{path}: proof of two histories: {what}" for what in kept.contradictions)
    for line, head in kept.newest_of_each.values():
        source = f"{path}: line {line}, received {when(head.received_utc_ns)}"
        given.heads.append(GivenHead(source, head.signed.json, elsewhere=True))


def _begin_of(path: Path) -> bytes:
    with open_recording(path) as file:
        return file.read(LARGEST + 1).rstrip(b"\n")
