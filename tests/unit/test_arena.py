"""One arena for all threads: counted by glibc itself, in a process of its own."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

MANY = """
import ctypes, threading
from agent.acquisition.arena import one_arena
libc = ctypes.CDLL(None)
libc.fopen.restype = libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes, libc.malloc_info.argtypes = [ctypes.c_size_t], [ctypes.c_int, ctypes.c_void_p]
libc.fclose.argtypes = [ctypes.c_void_p]
{first}
together = threading.Barrier(8)
def allocate():
    together.wait()
    for _ in range(100):
        libc.malloc(5000)
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
file = libc.fopen({told!r}, b"w")
libc.malloc_info(0, file)
libc.fclose(file)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="only glibc counts its arenas")
@pytest.mark.parametrize(("first", "one"), [("one_arena()", True), ("", False)])
def test_threads_share_one_arena(tmp_path: Path, first: str, one: bool) -> None:
    told = tmp_path / "arenas.xml"
    subprocess.run([sys.executable, "-c", MANY.format(first=first, told=bytes(told))], check=True)
    assert (told.read_text().count("<heap nr=") == 1) is one
