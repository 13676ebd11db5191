"""What is said of results that are shown: which are refused, which are not signed, and which key signed the others."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from agent.config.known_keys import identifier
from agent.delivery.history import History
from agent.delivery.record import StoredResult
from agent.recording.files import final_name, recordings
from agent.recording.result_signing import PUBLIC_KEY, SignedResult
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of


def evidence(history: History, shown: Iterable[StoredResult], directory: Path) -> list[str]:
    """Sentences on the results in `shown`, which `history` gave, on those that it refused, and on those that it lacks.

    `directory`: the data directory. Raises OSError.
    """
    records = {record.sequence: record for record in shown}
    unsigned = sum(not record.signed for record in records.values())
    said = [f"result {sequence} is refused: {reason}" for sequence, reason in sorted(history.refused.items())]
    if unsigned and (unsigned < len(records) or _signs(directory)):
        said.append(f"{unsigned} of the {len(records)} results shown are not signed, though this gateway has a key")
    return said + _lacking(history, directory)


def _lacking(history: History, directory: Path) -> list[str]:
    """A sentence where finished recordings are newer than the store, as after an older copy of it was put back."""
    known = history.file_sequence()
    newer = [path.name for number, path in recordings(directory) if number > known and path.name == final_name(path)]
    if not newer:
        return []
    return [f"the state file is older than {newer[0]} and lacks its results; the next `fieldcal run` adds them"]


def signed_with(shown: Iterable[StoredResult]) -> str:
    """The sentence on the keys that signed results which nobody checked with the gateway's key; "" for none."""
    keys = {SignedResult.read(record.signed).public_key for record in shown if record.signed}
    names = " and ".join(sorted(map(identifier, keys)))
    return f"signed with the key {names}; `--public-key` checks whether it is the gateway's" if names else ""


def _signs(directory: Path) -> bool:
    """Whether the newest recording names a key."""
    _, path = max(recordings(directory), default=(0, None))
    return path is not None and PUBLIC_KEY in metadata_of(path).get(FILE_METADATA, {})
