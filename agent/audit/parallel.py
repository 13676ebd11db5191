"""Does the same work for many files on several cores, and gives what comes out in the order of the files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

T = TypeVar("T")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def for_each(work: Callable[[Path], T], paths: Sequence[Path], jobs: int) -> Iterator[T]:
    """Yield work(path) of each file. With more than one of `jobs`, `work` and what it gives must be picklable.

    An exception of `work` is raised here. Memory: what came out of files waits until those before them are done.
    """
    pool = _pool(min(jobs, len(paths)))
    if pool is None:
        yield from map(work, paths)
        return
    with pool:
        yield from pool.map(work, paths)


def _pool(jobs: int) -> ProcessPoolExecutor | None:
    """So many processes; None where one is enough, or where the system has no semaphores (no /dev/shm).

    They come from a server without threads: a copy of this process could wait for ever for a lock that a thread of a
    library held when it was made.
    """
    if jobs < 2:
        return None
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    try:
        return ProcessPoolExecutor(jobs, mp_context=get_context("forkserver"))
    except (OSError, ImportError, ValueError):
        return None
