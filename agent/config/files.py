"""Opens files that a user or a stranger names: regular files only, and never more of them than a stated size.

A pipe or a device could make a program wait, or give data without end.
"""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

# A pipe without a writer would wait without O_NONBLOCK. Windows has neither of the first two, and needs the third.
_FLAGS = sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises OSError, also where `path` is a pipe, a device or a directory."""
    descriptor = os.open(path, os.O_RDONLY | _FLAGS)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return open(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "Not a regular file", str(path))


def read_file(path: Path, most: int) -> bytes:
    """Read a regular file of at most `most` bytes. Raises OSError."""
    with open_file(path) as file:
        return _read(file, path, most)


def read_private_file(path: Path, most: int) -> tuple[bytes, str]:
    """Read a file with a private key; gives its content, and why it is not its owner's alone, "" where it is.

    The rights are those of the opened file, so a name that leads elsewhere in the meantime makes no difference.
    Raises OSError.
    """
    with open_file(path) as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        exposed = f"other users can read or write this private key (mode {mode:04o}); run chmod 600 on it"
        return _read(file, path, most), exposed if mode & 0o077 else ""


def _read(file: BufferedReader, path: Path, most: int) -> bytes:
    data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"The file has more than {most} bytes, so it is not read", str(path))
    return data
