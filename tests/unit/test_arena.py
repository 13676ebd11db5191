"""One arena for all threads, and what is free goes back: counted by glibc and the kernel, in processes of their own."""

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


FREED = """
import ctypes, os
from agent.acquisition.arena import one_arena, return_free
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
one_arena()
before = resident()
blocks = [libc.malloc(20_000) for _ in range(2000)]
for block in blocks:
    ctypes.memset(block, 1, 20_000)
for k, block in enumerate(blocks):
    if k % 100 != 99:  # the last one stays, so that the end of the heap is in use
        libc.free(block)
full = resident()
return_free()
print(full - before, resident() - before)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="only glibc keeps holes and can return them")
def test_memory_between_blocks_in_use_goes_back_to_the_system() -> None:
    told = subprocess.run([sys.executable, "-c", FREED], check=True, stdout=subprocess.PIPE, text=True).stdout
    full_mb, left_mb = map(float, told.split())
    assert full_mb > 38.0
    assert left_mb < 3.0
