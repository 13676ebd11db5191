"""Runs a reader in a process of its own, because a damaged file can end the process, or take all memory."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.reading.source import TableError, bounded_memory

Name = tuple[str, ...]


def arrays_of(module: str, path: Path, memory_bytes: int, remedy: str) -> Iterator[tuple[Name, NDArray[Any]]]:
    """Yield each array that `python -m module` finds in the file, with the words that name it. Raises TableError."""
    command = [sys.executable, "-m", module, str(path), str(memory_bytes)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        reason = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2] or "its reader failed"
        raise TableError(f"{path}: the file cannot be read: {reason}; {remedy}")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        for k, name in enumerate(found["names"].tolist()):
            yield tuple(name), found[str(k)]


def write_arrays(read: Callable[[str], Mapping[Name, NDArray[Any]]], path: str, memory_bytes: str) -> None:
    """What the other process does: write the arrays to standard output, as npz without objects. Raises SystemExit."""
    with suppress(ImportError):  # Windows has none
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        with bounded_memory(int(memory_bytes)):
            found = read(path)
    except MemoryError:
        sys.exit("the file announces more than it holds")
    except Exception as error:  # the libraries raise many kinds for broken files
        sys.exit(str(error) or type(error).__name__)
    whole = io.BytesIO()
    names = np.array(list(found) or np.empty((0, 2)), dtype=str)
    np.savez(whole, names=names, **{str(k): array for k, array in enumerate(found.values())})  # type: ignore[arg-type]
    sys.stdout.buffer.write(whole.getbuffer())
