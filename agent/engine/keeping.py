"""Keeps the wheel of the running engine in a data directory: it can compute the recordings there again in ten years."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
from pathlib import Path

from agent.config.files import read_file
from agent.engine.identity import engine_id
from agent.engine.known import known_digests
from agent.engine.wheel import ENGINES, LARGEST, build, file_name
from agent.recording.files import sync_directory

_log = logging.getLogger(__name__)


def keep_engine(directory: Path) -> str:
    """Put the wheel of the running engine into a data directory, unless it is there; gives its SHA-256.

    A wheel of a release with the same id stays: it differs by comments alone. Where the wheel cannot be written, the
    log says so, and the agent goes on. The SHA-256 is "" where this Python cannot make the wheel (it has no bz2).
    """
    path = directory / ENGINES / file_name(engine_id())
    kept = b""
    with contextlib.suppress(OSError):
        kept = read_file(path, LARGEST)
    sha256 = hashlib.sha256(kept).hexdigest()
    if sha256 in known_digests(engine_id()):
        return sha256
    try:
        built = build()
    except (OSError, RuntimeError) as error:
        _log.warning("the engine of this run is not kept in %s: its wheel cannot be made: %s", path.parent, error)
        return ""
    if built != kept:
        try:
            _write(path, built)
        except OSError as error:
            _log.warning("the engine of this run is not kept: %s: %s", path, error.strerror or error)
    return hashlib.sha256(built).hexdigest()


def _write(path: Path, data: bytes) -> None:
    """Write a file that is whole or not there, whenever the power fails. A full disk is left as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".new")
    try:
        with open(beside, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)
