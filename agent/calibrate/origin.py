"""The files and options from which a result was made, so that a reader can find the files and check their content."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from agent.config.files import open_file

FILES = (
    "sensor",
    "reference",
    "poses",
    "prior",
    "reference_certificate",
    "sensor_metadata",
    "reference_metadata",
    "mapping",
)  # options of `fieldcal calibrate` that name a file


class SourceFile(msgspec.Struct, frozen=True):
    """A file that was read: `path` as the user gave it, `sha256` in hexadecimal."""

    path: str
    size_bytes: int
    sha256: str


def source_file(path: Path) -> SourceFile:
    """Measure and hash a file. Raises OSError."""
    with open_file(path) as file:
        return SourceFile(str(path), path.stat().st_size, hashlib.file_digest(file, "sha256").hexdigest())


def origin(options: Mapping[str, Any]) -> dict[str, Any]:
    """`options`, without the one for the output format, and the `files` that they name. Raises OSError."""
    kept = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
    kept.pop("json_to", None)
    return {
        "options": kept,
        "files": [msgspec.structs.asdict(source_file(options[name])) for name in FILES if options.get(name)],
    }
