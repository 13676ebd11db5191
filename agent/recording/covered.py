"""Is the digest of an unsigned recording in a signed one? So it is where a gateway got its key later."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from agent.recording.files import file_number, recordings
from agent.recording.reading import open_recording
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of
from agent.recording.signing import SIGNATURE_METADATA, signed_text

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys


def digest_is_signed(path: Path, gateway: str, keys: KnownKeys) -> bool:
    """Whether the recordings after this one name it by SHA-256, each the one before it, up to one that is signed.

    Raises OSError.
    """
    files, number = dict(recordings(path.parent)), file_number(path.name) or 0
    while (following := files.get(number + 1)) is not None and number in files:
        with open_recording(files[number]) as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        metadata, number = metadata_of(following), number + 1
        if (signature := metadata.get(SIGNATURE_METADATA)) is not None:
            signed = signed_text(signature)
            names_both = f"\nrecording {number}\nprevious {sha256}\n" in signed.text
            return names_both and not signed.fault_by(keys, gateway)
        if metadata.get(FILE_METADATA, {}).get("previous_sha256") != sha256:
            return False
    return False
