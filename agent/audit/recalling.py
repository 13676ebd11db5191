"""Gets the states of the estimation at the end of a recording, by replaying the recording.

Where the gateway has a key, a recording counts as far as the key covers it. A recording that was closed is covered by
its signature. One that a crash left open is covered by the head beside it, or, where it just began, by the recording
before it, which must end with the same states. What follows in it is not sealed yet: each result must have its
signature and follow from the data.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from agent.audit.replaying import EngineHere, Restore
from agent.core.events import RunStart
from agent.core.memory import Memory
from agent.engine import identity
from agent.recording.comparison import OTHER_CPU, compare
from agent.recording.continuation import continues
from agent.recording.files import file_number, recordings
from agent.recording.fingerprint import fingerprint
from agent.recording.head import begins_as_signed, head_beside
from agent.recording.integrity import check_integrity
from agent.recording.reading import REPAIR_METADATA, RecordingReader, first_event, open_recording
from agent.recording.result_check import check_results
from agent.recording.result_signing import PUBLIC_KEY
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of
from agent.recording.signing import SIGNATURE_METADATA, verify_file

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

LONGEST_CHAIN = 20  # recordings in a row that crashes left open; each was a start that ended at once

_log = logging.getLogger(__name__)


class UncoveredError(Exception):
    """A recording is not covered by the gateway's key. The message says why."""


def memories_of(path: Path, keys: KnownKeys | None, *, restore: Restore) -> list[Memory] | None:
    """The states of the estimation where a recording ends, or where a power cut tore it.

    `restore(config_json, snapshot)` makes the pipeline. The states include those of earlier runs in its snapshot.
    With `keys`, only what they cover counts. None where the recording cannot be replayed or is not covered; a warning
    in the log says why.
    """
    try:
        return _memories(path, restore, keys, LONGEST_CHAIN)
    except UncoveredError as error:
        _log.warning("%s: the states of the estimation are not taken from it: %s", path, error)
    except Exception as error:  # a damaged or forged snapshot may raise any exception
        _log.warning("%s: does not replay; the states of the estimation in it are not restored: %s", path, error)
    return None


def _memories(path: Path, restore: Restore, keys: KnownKeys | None, further: int) -> list[Memory]:
    if keys is None or _is_sealed(path, keys):
        return _replayed(path, restore, unsealed=False)
    start = first_event(path)
    if start is None:
        raise UncoveredError("it has no first event")
    if not _head_covers(path, start, keys):
        _compare_with_before(path, start, restore, keys, further)
    if PUBLIC_KEY not in metadata_of(path).get(FILE_METADATA, {}):
        raise UncoveredError("its results are not signed")
    checked = check_results(path, f"{start.site}/{start.gateway}", keys)
    if checked.fault:
        raise UncoveredError(f"{checked.faults} results without a valid signature; the first: {checked.fault}")
    return _replayed(path, restore, unsealed=True)


def _is_sealed(path: Path, keys: KnownKeys) -> bool:
    """Whether a recording was closed by its run, and not after a crash. Raises UncoveredError where it was changed."""
    with open_recording(path) as file:
        size = file.seek(0, 2)
        file.seek(0)
        integrity = check_integrity(file, size)
        if not integrity.finished or REPAIR_METADATA in integrity.metadata:
            return False
        start = first_event(path)
        if start is None or start.file_sequence != file_number(path.name):
            raise UncoveredError("its first event does not name it")
        said = integrity.statement(f"{start.site}/{start.gateway}", start.file_sequence)
        if fault := verify_file(file, size, integrity.metadata.get(SIGNATURE_METADATA), keys, said):
            raise UncoveredError(fault)
    return True


def _head_covers(path: Path, start: RunStart, keys: KnownKeys) -> bool:
    """Whether the head beside a recording is of it, and its bytes up to there, its snapshot among them, are the same.

    Raises UncoveredError where they are others.
    """
    head = head_beside(path, f"{start.site}/{start.gateway}", keys)
    if head is not None and not begins_as_signed(path, head):
        raise UncoveredError(f"its first {head.statement.length} bytes are not those that the gateway signed")
    return head is not None


def _compare_with_before(path: Path, start: RunStart, restore: Restore, keys: KnownKeys, further: int) -> None:
    """The states in a snapshot must be those with which the recording before ends. Raises UncoveredError."""
    pipeline = restore(start.config_json, start.snapshot)
    number = file_number(path.name) or 0
    before = next((one for at, one in recordings(path.parent) if at == number - 1), None)
    if (before is None and number > 1) or not further:
        raise UncoveredError("no head beside it names it, and the recording before it is not there")
    left = _memories(before, restore, keys, further - 1) if before is not None else []
    kept = pipeline.all_memories()
    if fault := continues(left, kept, {memory.sensor for memory in [*left, *kept]}):
        raise UncoveredError(fault)


def _replayed(path: Path, restore: Restore, *, unsealed: bool) -> list[Memory]:
    """The states at the end. What is `unsealed` counts as far as its results follow from its data."""
    engine, tolerance = EngineHere(restore, identity.name()), 0.0
    for step in RecordingReader(path).steps():
        before: list[Memory] = []
        if isinstance(step.event, RunStart):
            tolerance = 0.0 if step.event.fingerprint == fingerprint() else OTHER_CPU
            computed = engine.begin(step)
        else:
            before = [] if step.complete else engine.memories()
            computed = engine.step(step)
        if not step.complete and len(computed) > len(step.results):
            return before  # results of this event are not in the file, so they were never published: leave it out
        if unsealed and (computed or step.results):
            found = compare(str(path), step.event_sequence, step.results, computed, tolerance, complete=step.complete)
            if found is not None:
                raise UncoveredError(f"its results do not follow from its data: {found}")
    return engine.memories()
