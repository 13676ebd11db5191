"""A bit that changed in the state file: the file is set aside, or nothing of what it says is another."""

from __future__ import annotations

import random
import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError
from agent.delivery.store import Store
from tests.unit.results import calibration, status, window

FLIPS = 120  # of some 390,000 bits, and as many of the header's
SEED = 7
HEADER = 100  # bytes


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of a sensor that was A, then B."""
    directory = tmp_path_factory.mktemp("sound")
    store = Store(directory, 0)
    results = [
        window(1), calibration(2, identity="A"), status(3), window(4), calibration(5, identity="A"),
        status(6, "UNCALIBRATED"), calibration(7, identity="B"), status(8),
    ]  # fmt: skip
    store.commit([StoredResult.of(r, recorded=True, recording="fieldcal-000001.mcap") for r in results])
    store.mark_published(6)
    store.mark_file(1)
    store.close()
    return directory / FILE_NAME


def said(path: Path) -> tuple[Any, ...]:
    with History(path) as history:
        history.check()
        return history.after(0, limit=100), history.latest(), history.calibrations("mems"), history.removed()


def bits() -> list[tuple[int, int]]:
    chance = random.Random(SEED)
    header = [(offset, bit) for offset in range(HEADER) for bit in range(8)]
    return chance.sample(header, FLIPS) + [(-1 - chance.randrange(40_000), chance.randrange(8)) for _ in range(FLIPS)]


@pytest.mark.slow
def test_a_flipped_bit_is_found_or_harmless(sound: Path, tmp_path: Path) -> None:
    whole, expected = sound.read_bytes(), said(sound)
    found = 0
    for offset, bit in bits():
        directory = tmp_path / "work"
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir()
        changed = bytearray(whole)
        changed[offset] ^= 1 << bit
        path = directory / FILE_NAME
        path.write_bytes(changed)
        place = f"byte {offset}, bit {bit}"
        with suppress(StoreError):
            assert said(path) == expected, place
        store = Store(directory, 0)
        if store.set_aside is None:
            assert said(path) == expected, place
            assert (store.last_sequence(), store.published(), store.file_sequence()) == (8, 6, 1), place
        else:
            assert store.set_aside.read_bytes() == bytes(changed)
            found += 1
        store.close()
    assert found > 20  # most of the file is empty pages, but not all


@pytest.mark.parametrize("column", ["payload", "identity", "run_id", "recorded", "t_utc_ns", "recording"])
def test_a_value_that_changed_within_a_sound_page_is_found(sound: Path, tmp_path: Path, column: str) -> None:
    path = Path(shutil.copy(sound, tmp_path / FILE_NAME))
    connection = sqlite3.connect(path)
    changes = {"recorded": "0", "t_utc_ns": "t_utc_ns + 1"}
    change = changes.get(column, f"{column} || 'x'")
    if column == "payload":
        change = "CAST(replace(CAST(payload AS TEXT), '26154', '26155') AS BLOB)"
    connection.execute(f"UPDATE results SET {column} = {change} WHERE sequence = 7")
    connection.commit()
    connection.close()
    with History(path) as history, pytest.raises(StoreError, match="begins with 7 is damaged"):
        history.in_force("mems")
    store = Store(tmp_path, 0)
    assert store.set_aside is not None
    store.close()


def test_what_a_kill_left_half_written_is_rolled_back(sound: Path, tmp_path: Path) -> None:
    right = said(sound)
    half = tmp_path / "half"
    shutil.copytree(sound.parent, half)
    with closing(sqlite3.connect(half / FILE_NAME, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.execute("PRAGMA cache_size = 1")  # page; what changes reaches the file before it is committed
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("UPDATE results SET payload = zeroblob(5000)")
        killed = tmp_path / "killed"
        shutil.copytree(half, killed)
    assert (killed / FILE_NAME).read_bytes() != sound.read_bytes()
    assert (killed / f"{FILE_NAME}-journal").stat().st_size > 0
    store = Store(killed, 0)
    store.close()
    assert store.set_aside is None
    assert said(killed / FILE_NAME) == right


def test_the_journal_of_a_store_that_is_set_aside_goes_with_it(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_bytes(b"a store no more, and longer than a header" * 5)
    (tmp_path / f"{FILE_NAME}-journal").write_bytes(b"nor a journal")
    (tmp_path / f"{FILE_NAME}-wal").write_bytes(b"nor a log")
    store = Store(tmp_path, 0)
    store.close()
    assert store.set_aside is not None
    assert (tmp_path / f"{FILE_NAME}-journal.corrupt-1").read_bytes() == b"nor a journal"
