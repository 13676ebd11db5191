"""What is said of results that are shown: which are refused, which are not signed, and which key signed the others."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from agent.config.known_keys import identifier
from agent.delivery.history import History
from agent.delivery.record import Record
from agent.recording.files import recordings
from agent.recording.result_signing import PUBLIC_KEY, SignedResult
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of


def evidence(history: History, shown: Iterable[Record], directory: Path, *, checked: bool) -> list[str]:
    """Sentences on the results in `shown`, which `history` gave, and on those that it refused.

    `directory`: the data directory. `checked`: the reader gave the gateway's key. Of a gateway that signs nothing,
    there is nothing to say. Raises OSError.
    """
    records = {record.sequence: record for record in shown}
    keys = {SignedResult.read(record.signed).public_key for record in records.values() if record.signed}
    unsigned = sum(not record.signed for record in records.values())
    said = [f"result {sequence} is refused: {reason}" for sequence, reason in sorted(history.refused.items())]
    if unsigned and (keys or _signs(directory)):
        said.append(f"{unsigned} of the {len(records)} results shown are not signed, though this gateway has a key")
    if keys and not checked:
        names = " and ".join(sorted(map(identifier, keys)))
        said.append(f"signed with the key {names}; `fieldcal show --public-key` checks whether it is the gateway's")
    return said


def _signs(directory: Path) -> bool:
    """Whether the newest recording names a key."""
    _, path = max(recordings(directory), default=(0, None))
    return path is not None and PUBLIC_KEY in metadata_of(path).get(FILE_METADATA, {})
