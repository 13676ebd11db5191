"""Rows on disk: the same as an array where they are sliced, gone with their last user, and a full disk is told."""

from __future__ import annotations

import errno
import gc
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from agent.reading.spool import Spool, Spooled


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_slices_are_those_of_an_array() -> None:
    rows = np.random.default_rng(1).normal(size=(100, 4))
    spool = Spool(4)
    for first in range(0, 100, 30):
        spool.append(rows[first : first + 30])
        spool.read(0, 1)  # reading in between does not move where the next rows go
    time, channels = Spooled(spool, 0), Spooled(spool, slice(1, 4))
    assert (len(time), len(channels)) == (100, 100)
    for part in (slice(None), slice(5, 40), slice(95, 200), slice(-3, None), slice(7, 7), slice(0, 100, 9)):
        np.testing.assert_array_equal(time[part], rows[part, 0])
        np.testing.assert_array_equal(channels[part], rows[part, 1:])


def test_the_file_goes_with_its_last_user() -> None:
    before = open_files()
    column = Spooled(Spool(2), 1)
    assert open_files() == before + 1
    del column
    gc.collect()
    assert open_files() == before


def test_a_full_disk_is_told_with_its_directory_and_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    spool = Spool(4)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(OSError, match="set TMPDIR to a directory") as raised:
            spool.append(np.zeros((1000, 4)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (raised.value.errno, raised.value.filename) == (errno.EFBIG, str(tmp_path))
