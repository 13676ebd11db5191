"""What a consumer remembers over its restarts, and what it is told where retention was faster."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

import pytest

from agent.delivery import memory
from agent.delivery.consumer import Consumer
from agent.delivery.memory import MemoryFileError
from agent.delivery.retention import KeepResults
from tests.unit.test_consumer import Gateway
from tests.unit.zenoh_site import Site, record


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Gateway]:
    gateway = Gateway(site, tmp_path / "gateway")
    gateway.publisher.start()
    yield gateway
    gateway.stop()


def test_a_consumer_goes_on_where_it_was_done(site: Site, gateway: Gateway, tmp_path: Path) -> None:
    path = tmp_path / "memory.json"
    memory.save(path, {"site/gw": gateway.base})
    gateway.send(50)
    gateway.wait_until_out()
    numbers: list[int] = []
    for count in (20, 30):
        with Consumer([site.endpoint], memory=path) as consumer:
            results = iter(consumer)
            numbers += [r.sequence - gateway.base for r in islice(results, count)]
            results.close()  # type: ignore[attr-defined]
    # The 20th was given but never asked beyond: whoever had it may have failed with it, so it comes again.
    assert numbers == [*range(1, 21), *range(20, 50)]


def test_what_was_not_asked_beyond_is_not_remembered(site: Site, gateway: Gateway, tmp_path: Path) -> None:
    path = tmp_path / "memory.json"
    memory.save(path, {"site/gw": gateway.base, "site/other": 7})
    gateway.send(3)

    def fail_at_the_third(consumer: Consumer) -> None:
        for result in consumer:
            if result.sequence == gateway.base + 3:
                raise RuntimeError("the consumer's own fault")

    with Consumer([site.endpoint], memory=path) as consumer, pytest.raises(RuntimeError):
        fail_at_the_third(consumer)
    assert memory.load(path) == {"site/gw": gateway.base + 2, "site/other": 7}


def test_who_comes_too_late_is_told_once(site: Site, tmp_path: Path) -> None:
    gateway = Gateway(site, tmp_path / "gateway")
    gateway.store._sweep._keep = KeepResults(bytes=1)
    base = gateway.base
    for number in range(1, 101):
        gateway.store.commit([record(base + number, "calibration" if number == 5 else "window")])
        gateway.store.mark_published(base + number)
    gateway.publisher.start()
    with Consumer([site.endpoint], last_sequence={"site/gw": base + 2}) as consumer:
        results = list(islice(consumer, 2))
    assert [r.sequence - base for r in results] == [5, 100]
    assert [r.removed_up_to and r.removed_up_to - base for r in results] == [99, None]
    with Consumer([site.endpoint], "fieldcal/v1/*/*/*/calibration", {"site/gw": base + 2}) as consumer:
        (result,) = islice(consumer, 1)
    assert (result.sequence - base, result.removed_up_to) == (5, None), "no calibration was removed"
    gateway.stop()


def test_every_bit_of_the_memory_counts(tmp_path: Path) -> None:
    path = tmp_path / "memory.json"
    kept = {"site/gw": 1_790_000_000_123, "a/b": 7}
    memory.save(path, kept)
    whole = path.read_bytes()
    for offset in range(len(whole)):
        for bit in range(8):
            changed = bytearray(whole)
            changed[offset] ^= 1 << bit
            path.write_bytes(changed)
            with suppress(MemoryFileError):
                assert memory.load(path) == kept, (offset, bit)


def test_a_memory_that_is_none_is_refused_and_none_is_empty(tmp_path: Path) -> None:
    assert memory.load(tmp_path / "none") == {}
    with pytest.raises(MemoryFileError, match="cannot be read: Is a directory"):
        memory.load(tmp_path)
    chance = random.Random(1)
    for _ in range(100):
        (tmp_path / "noise").write_bytes(chance.randbytes(chance.randrange(200)))
        with pytest.raises(MemoryFileError, match="not the memory file of a consumer"):
            memory.load(tmp_path / "noise")
