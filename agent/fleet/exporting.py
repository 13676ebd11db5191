"""Samples of a recording as files of other programs, one for each of its sensors."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import msgspec

from agent.export.samples import RecordedContent, content_of, samples, sensors_of
from agent.export.seismic import write_mseed
from agent.export.tables import write_csv, write_parquet
from agent.export.uff import write_uff

Write = Callable[..., int]
WRITE: dict[str, Write] = {"csv": write_csv, "parquet": write_parquet, "uff": write_uff, "mseed": write_mseed}


class Exported(msgspec.Struct, frozen=True, kw_only=True):
    """One file. `ends_early`: why the recording does; "" where it is whole."""

    device: str
    file: str
    samples: int
    bytes: int
    sha256: str
    ends_early: str = ""


def exported(path: Path, place: str, ending: str, directory: Path) -> list[Exported]:
    """Write the samples of each sensor of the recording at `path`, whose place is `place`, into a directory.

    A file is complete or not there at all; one that is there is replaced. Raises ExportError or OSError.
    """
    sensors = dict.fromkeys(sensors_of(path))
    return [_exported(path, content_of([path], sensor), stem(place), ending, directory) for sensor in sensors]


def stem(place: str) -> str:
    """How the files of the recording at `place` begin: its name, and a digest of its whole path."""
    return f"{_plain(PurePosixPath(place).name)}.{hashlib.sha256(os.fsencode(place)).hexdigest()[:16]}"


def _exported(path: Path, content: RecordedContent, begin: str, ending: str, directory: Path) -> Exported:
    file = directory / f"{begin}.{_plain(content.device)}.{ending}"
    new = file.with_name(f"{file.name}.new")
    new.unlink(missing_ok=True)
    rows = WRITE[ending](new, content, samples([path], content))
    with new.open("rb") as written:
        os.fsync(written.fileno())
        digest = hashlib.file_digest(written, "sha256").hexdigest()
        size = written.tell()
    new.replace(file)
    early = "; ".join(content.faults).removeprefix(f"{path}: ")
    return Exported(device=content.device, file=file.name, samples=rows, bytes=size, sha256=digest, ends_early=early)


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:80]
