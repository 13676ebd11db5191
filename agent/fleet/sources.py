"""Where the recordings lie: on disks that all machines see, or at an address that fsspec reads (s3://bucket/...).

Credentials come from the environment of each worker only. An address that carries one is refused.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

ENDING = ".mcap"
LARGEST_FETCHED = 8 << 30  # bytes of a recording at an address; it is copied to this machine's temporary directory
_PIECE = 4 << 20
_WILD = re.compile(r"[*?\[]")


class SourceError(Exception):
    """What was given names no recordings, or cannot be read. The message names it; it holds no credentials."""


def is_address(place: str) -> bool:
    """Whether fsspec must read it."""
    return "://" in place


def recordings_in(given: Iterable[str]) -> list[str]:
    """The recordings that files, directories, patterns and addresses name; each once, in the order of what was given.

    A directory stands for all files in it, and below it, that end in `.mcap`. Raises SourceError.
    """
    places: dict[str, None] = {}
    for name in given:
        some = _at_address(name) if is_address(name) else _on_disk(name)
        if not some:
            raise SourceError(f"{name}: there is no recording ({ENDING}) here")
        places |= dict.fromkeys(some)
    return list(places)


@contextmanager
def local(place: str) -> Iterator[Path]:
    """The recording as a file of this machine; one at an address is copied, and deleted afterwards.

    Raises SourceError, or OSError where the copy cannot be written.
    """
    if not is_address(place):
        yield Path(place)
        return
    with TemporaryDirectory(prefix="fieldcal-fleet-") as directory:
        path = Path(directory) / "fetched.mcap"
        filesystem, inner = _filesystem(place)
        try:
            with filesystem.open(inner, "rb") as source, open(path, "xb") as copy:
                while piece := source.read(_PIECE):
                    if copy.tell() + len(piece) > LARGEST_FETCHED:
                        raise SourceError(f"{place}: larger than the limit of {LARGEST_FETCHED} bytes")
                    copy.write(piece)
        except SourceError:
            raise
        except Exception as error:  # each file system has its own
            raise SourceError(f"{place}: cannot be read: {_short(error)}") from None
        yield path


def _on_disk(name: str) -> list[str]:
    path = Path(name)
    if path.is_dir():
        return sorted(str(file.absolute()) for file in path.rglob(f"*{ENDING}") if file.is_file())
    if path.exists() or not _WILD.search(name):
        if not path.is_file():
            raise SourceError(f"{name}: no such file or directory")
        return [str(path.absolute())]
    return sorted(os.path.abspath(file) for file in glob.glob(name, recursive=True) if os.path.isfile(file))


def _at_address(name: str) -> list[str]:
    filesystem, inner = _filesystem(name)
    try:
        if _WILD.search(inner):
            files = filesystem.glob(inner)
        elif filesystem.isdir(inner):
            files = [file for file in filesystem.find(inner) if file.endswith(ENDING)]
        else:
            files = [inner] if filesystem.exists(inner) else []
        return sorted(str(filesystem.unstrip_protocol(file)) for file in files)
    except Exception as error:  # as above
        raise SourceError(f"{name}: cannot be read: {_short(error)}") from None


def _filesystem(place: str) -> tuple[Any, str]:
    """(the file system, the path in it). Raises SourceError."""
    parts = urlsplit(place)
    if "@" in parts.netloc or "::" in place or (parts.query and parts.scheme in ("http", "https")):
        host = parts.netloc.rpartition("@")[2]
        bare = "..." if "::" in place else f"{parts.scheme}://{host}{parts.path}"
        raise SourceError(
            f"{bare}: an address must not carry a user, password, signature or second address; set the credentials in "
            "the environment of each worker, such as AWS_ACCESS_KEY_ID"
        )
    try:
        import fsspec
    except ImportError:
        raise SourceError(f"{place}: needs fsspec; install it with: fieldcal extras --install fleet") from None
    try:
        filesystem, inner = fsspec.core.url_to_fs(place)
    except Exception as error:  # an unknown kind of address, or its library is missing
        raise SourceError(f"{place}: {_short(error)}") from None
    return filesystem, str(inner)


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:200]}"
