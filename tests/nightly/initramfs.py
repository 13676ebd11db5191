"""First files of the machine: busybox, the modules, and a script that loads them and then executes commands."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Iterator
from pathlib import Path

INIT = Path(__file__).with_name("init.sh")


def initramfs(modules: dict[str, bytes]) -> bytes:
    """An initial file system, compressed. Raises FileNotFoundError if busybox is missing."""
    busybox = shutil.which("busybox")
    if busybox is None:
        raise FileNotFoundError("busybox is missing: apt-get install busybox-static")
    files = {"init": INIT.read_bytes(), "bin/busybox": Path(busybox).read_bytes()}
    files |= {f"modules/{number:02}-{name}.ko": content for number, (name, content) in enumerate(modules.items())}
    return gzip.compress(b"".join(_archive(files)), compresslevel=1)


def _archive(files: dict[str, bytes]) -> Iterator[bytes]:
    """cpio's format `newc` (Linux, Documentation/driver-api/early-userspace/buffer-format.rst)."""
    for directory in sorted({name.rpartition("/")[0] for name in files} - {""}):
        yield _entry(directory, 0o040755, b"")
    for name, content in files.items():
        yield _entry(name, 0o100755, content)
    yield _entry("TRAILER!!!", 0, b"")


def _entry(name: str, mode: int, content: bytes) -> bytes:
    numbers = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % number for number in numbers) + name.encode() + b"\0"
    return _padded(head) + _padded(content)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
