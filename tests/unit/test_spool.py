"""Rows on disk: the same as an array where they are sliced, gone with their last user, and a full disk is told."""

from __future__ import annotations

import errno
import os
import resource
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from agent.reading.spool import Spool, Spooled
from calib.recorded.table import ReferenceTable
from calib.recorded.wrong_unit import check_gravity


def open_files(directory: Path) -> int:
    """How many files of a directory this process has open, also those without a name."""
    links = Path("/proc/self/fd").iterdir()
    return sum(os.readlink(link).startswith(f"{directory}/") for link in links if link.is_symlink())


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


def test_looking_at_some_rows_needs_no_memory_for_the_others() -> None:
    """`check_gravity` looks at 100,000 rows, spread over the file: 2.4 MB, where all have 96 MB."""
    spool = Spool(4)
    for _ in range(40):
        spool.append(np.tile([0.0, 0.0, 0.0, 9.81], (75_000, 1)))
    reference = ReferenceTable("reference", Spooled(spool, 0), Spooled(spool, slice(1, 4)), "acceleration", "ax")
    tracemalloc.start()
    check_gravity(reference)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15e6


def test_the_file_goes_with_its_last_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    column = Spooled(Spool(2), 1)
    assert open_files(tmp_path) == 1
    del column
    assert open_files(tmp_path) == 0


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
