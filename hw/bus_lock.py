"""A lock on one address of a bus, so that two programs that lock do not read the same device.

i2c-dev and spidev have no lock. The lock is one byte of the device node, at the offset of the address: an
open-file-description lock (fcntl(2)). It also excludes two openings in one process, leaves other addresses of the bus
free, needs no file of its own, and ends with the process. A program that does not ask for the lock is not kept off.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import struct
from pathlib import Path

from hw.sensor import DeviceLost

PROC = Path("/proc")
_FLOCK = struct.Struct("hh4xqqi4x")  # struct flock of 64-bit Linux: type, whence, start, length, process


def lock(file: int, path: str, address: int, name: str) -> None:
    """Lock `address` of the node `path`, which `file` has open for writing, until it is closed.

    `name` is the device, for the message. Raises DeviceLost where another opening holds the lock; the message names its
    process.
    """
    wanted = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, address, 1, 0)
    try:
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, wanted)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise DeviceLost(f"{name}: it cannot be locked: {error.strerror}") from error
        raise DeviceLost(f"{name}: {holder(path, address) or 'another program'} uses it; end that first") from error


def holder(path: str, address: int) -> str:
    """The process that holds the lock on `address` of the node `path`, e.g. "process 812 (fieldcal)"; "" for none.

    A process of another user does not show its locks, unless this one is root.
    """
    with contextlib.suppress(OSError):
        node = os.stat(path)
        for process in PROC.iterdir():
            if process.name.isdigit() and _holds(process, node, address):
                return f"process {process.name} ({(process / 'comm').read_text(errors='replace').strip()})"
    return ""


def _holds(process: Path, node: os.stat_result, address: int) -> bool:
    """Whether an open file of this process is the node and has the lock (proc(5), fdinfo)."""
    with contextlib.suppress(OSError):
        for file in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                if not os.path.samestat(file.stat(), node):
                    continue
                for line in (process / "fdinfo" / file.name).read_text().splitlines():
                    if line.startswith("lock:") and line.split()[-2:] == [str(address)] * 2:
                        return True
    return False
