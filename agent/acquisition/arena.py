"""Keeps the memory of an agent of many threads small."""

from __future__ import annotations

import contextlib
import ctypes

_ARENA_MAX = -8  # M_ARENA_MAX of glibc's malloc.h


def one_arena() -> None:
    """Let all threads of this process allocate from one arena; to be called before the threads start.

    By default glibc gives each thread its own arena, and what one arena has free no other can use: 2 to 3 MB with
    nine threads. The threads of the agent rarely allocate at the same time, so that they do not wait for each other.
    Another C library than glibc is left as it is.
    """
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def return_free() -> None:
    """Return to the system all memory that this process has freed, also between blocks that it uses.

    A solution of all records allocates tens of MB of small arrays. Without this call the holes between those that stay
    are kept, and differ after each solution, so that the process grows: by 42 MB after 1,000 windows. It takes 0.1 to
    1 ms.
    """
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
