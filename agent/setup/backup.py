"""Copies a data directory so that the copy is consistent, also while the agent writes."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import sqlite3
import stat
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

from agent.config import Config
from agent.delivery.history import FILE_NAME, connect_read_only
from agent.delivery.schema import write_mark
from agent.engine.wheel import ENGINES
from agent.recording.deleted_list import LIST_NAME
from agent.recording.files import ACTIVE_SUFFIX, recordings
from agent.recording.head import HEAD_NAME
from agent.recording.reading import open_recording

DATA, KEYS, SUMS = "data", "keys", "SHA256SUMS"
# The head; statements about recordings that retention deleted; pins that keep a recording. Nothing else is copied, so
# no key that lies there, and not the counters of commands: with older counters a command could be repeated.
_SMALL = re.compile(rf"{HEAD_NAME}|fieldcal-\d{{6,18}}\.(deleted|mcap\.lock)")
# With these the names of the agent's files begin.
_OWN = (HEAD_NAME, ENGINES, LIST_NAME, "fieldcal-", "state.", "command")


class BackupError(Exception):
    """A backup cannot be made. The message names the file and what to do."""


def _begin(data_dir: Path, target: Path) -> Path:
    """Make the directory that becomes `target` when it is complete. Raises BackupError or OSError."""
    if target.exists():
        raise BackupError(f"{target}: it exists; name a new directory")
    if not data_dir.is_dir():
        raise BackupError(f"{data_dir}: there is no such data directory")
    partial = target.with_name(target.name + ".partial")
    try:
        partial.mkdir(parents=True, mode=0o700)
    except FileExistsError:
        raise BackupError(f"{partial}: an earlier backup did not end; remove this directory") from None
    return partial


def back_up(data_dir: Path, target: Path, config_path: Path | None, keys: Iterable[Path]) -> list[Path]:
    """Copy a data directory, and the files that are named, to the new directory `target`; returns the copied files.

    The order makes the copy like a gateway after a power cut, which a start repairs: first the small files, such as the
    head of the recordings, then the store, at one moment (SQLite's backup), then the recordings, which reach at least
    as far as both, then the list of deleted recordings, which has all that they name. The file that is being written is
    copied as far as it is written.

    Raises BackupError or OSError. What was begun is then left beside `target`, with the ending .partial.
    """
    partial = _begin(data_dir, target)
    data = partial / DATA
    data.mkdir()
    for path in _regular(path for path in data_dir.iterdir() if _SMALL.fullmatch(path.name)):
        _copy(path, data / path.name)
    if (data_dir / FILE_NAME).exists():
        _copy_store(data_dir / FILE_NAME, data / FILE_NAME)
    for _, path in recordings(data_dir):
        _copy_recording(path, data)
    for path in _regular((data_dir / ENGINES).glob("*.whl")):  # last, so that none of a recording is missing
        (data / ENGINES).mkdir(exist_ok=True)
        _copy(path, data / ENGINES / path.name)
    if (data_dir / LIST_NAME).exists():
        _copy(data_dir / LIST_NAME, data / LIST_NAME)
    if config_path is not None:
        _copy(config_path, partial / config_path.name)
    for key in keys:
        (partial / KEYS).mkdir(exist_ok=True, mode=0o700)
        _copy(key, partial / KEYS / key.name)
    copied = sorted(path for path in partial.rglob("*") if path.is_file())
    sums = "".join(f"{_sha256(path)}  {path.relative_to(partial)}\n" for path in copied)
    (partial / SUMS).write_text(sums, "utf-8")
    _sync(partial)
    partial.rename(target)
    return [target / path.relative_to(partial) for path in copied]


def key_files(config: Config) -> list[Path]:
    """The key, password and certificate files that a configuration names."""
    named = [config.recording.signing_key] if config.recording.signing_key else []
    tls, mqtt = config.zenoh.tls, config.mqtt
    named += [Path(tls.ca), Path(tls.certificate), Path(tls.key)] if tls else []
    of_broker = (mqtt.tls.ca, mqtt.tls.certificate, mqtt.tls.key) if mqtt.tls else ()
    return named + [path for path in (mqtt.password_file, *of_broker) if path is not None]


def left_out(data_dir: Path) -> list[str]:
    """Names in a data directory that the agent did not make, and that are not copied. Raises OSError."""
    return sorted(path.name for path in data_dir.iterdir() if not path.name.startswith(_OWN))


def _regular(paths: Iterable[Path]) -> list[Path]:
    """The regular files among them, in order: no link, and nothing in a linked directory."""
    return sorted(path for path in paths if stat.S_ISREG(path.lstat().st_mode) and not path.parent.is_symlink())


def _copy_store(source: Path, target: Path) -> None:
    try:
        with closing(connect_read_only(source)) as read, closing(sqlite3.connect(target)) as write:
            read.backup(write)
            (verdict,) = write.execute("PRAGMA integrity_check(1)").fetchone()
            if verdict == "ok":
                # As after a crash: an agent that goes on with the copy reads the recordings, and skips numbers of
                # results, which the original may have used meanwhile.
                with write:
                    write_mark(write, "clean", 0)
    except sqlite3.Error as error:
        if error.sqlite_errorname in ("SQLITE_FULL", "SQLITE_IOERR_WRITE"):
            raise OSError(errno.ENOSPC, f"the copy of the store cannot be written: {error}", str(target)) from None
        raise BackupError(f"{source}: {error}; start the agent once, which repairs its store") from None
    if verdict != "ok":
        raise BackupError(f"{source}: damaged: {verdict}; start the agent once, which repairs its store")
    shutil.copymode(source, target)


def _copy_recording(path: Path, directory: Path) -> None:
    """Copy one recording. One that was closed meanwhile has lost the ending .active; one that retention deleted is
    left out."""
    for candidate in (path, path.with_name(path.name.removesuffix(ACTIVE_SUFFIX))):
        try:
            source = open_recording(candidate)  # retention keeps it while it is open
        except FileNotFoundError:
            continue
        with source, open(directory / candidate.name, "xb") as target:
            shutil.copyfileobj(source, target, 1 << 20)
        shutil.copystat(candidate, directory / candidate.name)
        return


def _copy(source: Path, target: Path) -> None:
    if target.exists():
        raise BackupError(f"{source}: another file of the backup has the same name; rename one of them")
    shutil.copy2(source, target)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(directory: Path) -> None:
    """Write everything to the disk before the directory gets its name."""
    for path in (*directory.rglob("*"), directory):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
