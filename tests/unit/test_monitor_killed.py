"""The monitor is killed between two batches of results, and within one: none is lost, none is there twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.monitor.engines import DatabaseEngine, open_engine
from tests.unit.postgres import postgres
from tests.unit.zenoh_site import Site, record, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
from tests.unit.monitor_site import Monitor

RESULTS = 3000
KILLED_AT = (1, 1500)  # results in the database when the monitor is killed


@pytest.fixture(params=["SQLite", "PostgreSQL"])
def url(request: pytest.FixtureRequest) -> Iterator[str | None]:
    if request.param == "SQLite":
        yield None
    else:
        with postgres() as address:
            yield address


def kept(engine: DatabaseEngine) -> list[int]:
    """The numbers in the database, in the order in which they came."""
    with engine.transaction() as run:
        return [sequence for (sequence,) in run("SELECT sequence FROM result ORDER BY number")]


@pytest.mark.one_case
def test_a_killed_monitor_loses_nothing_and_keeps_nothing_twice(site: Site, tmp_path: Path, url: str | None) -> None:
    settings = tmp_path / "monitor.toml"
    settings.write_text("" if url is None else f'[database]\nurl = "{url}"\n')
    store = Store(tmp_path / "gateway")
    first = store.last_sequence() + 1
    store.commit([record(first)])
    publisher = Publisher("site", "gw", [site.endpoint], store)
    publisher.start()

    def monitor() -> Monitor:
        return Monitor(site.endpoint, tmp_path / "monitor", "--config", str(settings))

    running = monitor()
    with closing(open_engine(tmp_path / "monitor", url)) as engine:
        wait_for(lambda: kept(engine) == [first])
        running.kill()
        store.commit([record(first + k) for k in range(1, RESULTS)])
        found = []
        for results in KILLED_AT:
            running = monitor()
            wait_for(lambda least=results: len(kept(engine)) > least)  # type: ignore[misc]
            running.kill()
            found.append(len(kept(engine)))
        assert found[-1] < RESULTS  # else it was not killed on its way
        running = monitor()
        try:
            wait_for(lambda: len(kept(engine)) >= RESULTS)
        finally:
            running.stop()
        assert kept(engine) == [first + k for k in range(RESULTS)]
    publisher.close()
    store.close()
