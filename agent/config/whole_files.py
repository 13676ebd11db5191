"""Writes files that are whole or not there: what was at the place before stays until the new file is complete."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

# Faults of the machine, not of what a user has stated: a full disk or quota, one that fails or is read-only, and no
# more files or memory.
MACHINE = frozenset(
    (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
)  # fmt: skip


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that takes the place of `path` at the end. Where writing fails, nothing is left of it.

    A pipe or a device is written to as it is. Raises OSError, which names `path`.
    """
    with named(path):
        if path.exists() and not path.is_file():
            with path.open("wb") as file:
                yield file
            return
        target = path.resolve()
        beside = target.with_name(f".{target.name}.partial")
        try:
            with beside.open("wb") as file:
                yield file
            with suppress(FileNotFoundError):
                shutil.copymode(target, beside)
            beside.replace(target)
        finally:
            with suppress(OSError):
                beside.unlink(missing_ok=True)


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write, which must not exist. It is removed again where writing fails. Raises OSError, which names
    `path`.
    """
    with named(path), path.open("xb") as file:
        try:
            yield file
            file.flush()
        except BaseException:
            path.unlink(missing_ok=True)
            raise


def write_whole(path: Path, data: bytes) -> None:
    """Write a file, see `whole_file`. Raises OSError."""
    with whole_file(path) as file:
        file.write(data)


def write_together(directory: Path, files: Mapping[str, bytes]) -> None:
    """Write files of one content: all of them or none. Raises OSError."""
    beside = {directory / name: directory / f".{name}.partial" for name in files}
    try:
        for (path, partial), data in zip(beside.items(), files.values(), strict=True):
            with named(path):
                partial.write_bytes(data)
        for path, partial in beside.items():
            with named(path):
                partial.replace(path)
    finally:
        for partial in beside.values():
            with suppress(OSError):
                partial.unlink(missing_ok=True)


def status_of(error: Exception) -> int:
    """The exit status of a command that could not read or write: 1 for a fault of the machine, else 2."""
    return 1 if isinstance(error, OSError) and error.errno in MACHINE else 2


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Give an OSError without a name the name `path`, as where a disk is full while a file is written."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and not str(error.filename).endswith(".partial"):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
