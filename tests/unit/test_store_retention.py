"""The store lets the oldest results go, never what waits, is newest of its kind, or may have to be restored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from agent.delivery.history import History, Removed, StoredResult
from agent.delivery.retention import DAY_NS, FOR_EACH_NEW, KeepResults
from agent.delivery.store import Store
from tests.unit.test_store import record, sequences, status

NOW_NS = 1_800_000_000 * 1_000_000_000


def results(first: int, count: int, age_days: float, what: str = "window", **fields: Any) -> list[StoredResult]:
    t_utc_ns = NOW_NS - int(age_days * DAY_NS)
    return [record(n, what, t_utc_ns=t_utc_ns, **fields) for n in range(first, first + count)]


def kept(store: Store) -> list[int]:
    with History(store.path) as history:
        history.check()
        return sequences(history.after(0, limit=10_000))


def filled(tmp_path: Path, keep: KeepResults, *batches: Sequence[StoredResult], published: int = 10_000) -> Store:
    store = Store(tmp_path, 0, keep)
    for batch in batches:
        store.commit(batch)
        store.mark_published(published)
    return store


def test_what_is_published_and_old_goes_and_is_counted(tmp_path: Path) -> None:
    store = filled(tmp_path, KeepResults(days=30), results(1, 40, 31), results(41, 10, 29), results(51, 20, 0))
    assert kept(store) == list(range(41, 71))
    with History(store.path) as history:
        assert history.removed() == [Removed("mems", "window", 40, 40)]
    store.close()


def test_two_at_most_go_for_each_new_one_so_that_a_wrong_clock_costs_little(tmp_path: Path) -> None:
    store = filled(tmp_path, KeepResults(days=30), results(1, 1000, 1), results(1001, 5, -20_000))
    assert kept(store) == list(range(1 + 5 * FOR_EACH_NEW, 1006))
    store.close()


def test_what_waits_stays_until_its_own_limit(tmp_path: Path) -> None:
    old = [results(1, 10, 400), results(11, 10, 200), results(21, 50, 0)]
    store = filled(tmp_path, KeepResults(days=30, bytes=1, waiting_days=365), *old, published=0)
    assert kept(store) == list(range(11, 71)), "published or not, a year is long enough"
    store.close()


def test_the_newest_of_each_kind_and_device_stay_however_old(tmp_path: Path) -> None:
    store = filled(
        tmp_path,
        KeepResults(days=30),
        results(1, 3, 500, "calibration", identity="A"),
        results(4, 3, 400, "calibration", identity="B"),
        [status(7, "UNCALIBRATED"), status(8, "COLLECTING")],
        results(9, 20, 300),
        results(29, 100, 0),
    )
    assert kept(store) == [3, 6, 8, *range(29, 129)]
    with History(store.path) as history:
        assert {i: r.sequence for i, r in history.calibrations("mems").items()} == {"A": 3, "B": 6}
        assert history.in_force("mems") is None, "though the status that withdrew it is gone"
    store.commit(results(129, 1, 0, "calibration", identity="B"))
    store.commit(results(130, 1, 0))
    assert kept(store)[:2] == [3, 8], "a newer one of B is there"
    store.close()
    again = Store(tmp_path, 0, KeepResults(days=30))
    assert again.set_aside is None
    again.close()


@pytest.mark.slow
def test_a_size_is_kept_to_over_ten_times_as_much(tmp_path: Path) -> None:
    size = 200_000
    store = filled(tmp_path, KeepResults(bytes=size))
    for number in range(1, 2001):
        store.commit([record(number, payload=b"x" * 1000)])
        store.mark_published(number)
    assert store.path.stat().st_size < 1.2 * size
    last = kept(store)
    assert last == list(range(last[0], 2001))
    assert 100 <= len(last) < 200
    store.close()


def test_what_is_deleted_survives_neither_a_rollback_nor_a_restart(tmp_path: Path) -> None:
    store = filled(tmp_path, KeepResults(days=30), results(1, 40, 31), results(41, 5, 0))
    before = kept(store)
    with pytest.raises(Exception, match="does not come after"):
        store.commit(results(1, 1, 0))
    assert kept(store) == before == list(range(11, 46))
    store.close()
    again = filled(tmp_path, KeepResults(days=30), results(46, 20, 0))
    assert kept(again) == list(range(41, 66))
    again.close()
