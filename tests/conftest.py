"""Settings of all tests."""

from __future__ import annotations

import gc
import json
import os
import signal
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# As every entry point does, and for the same reason: one thread, the same bits on every machine.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

from agent.engine import identity
from tests.quick import Quick

if TYPE_CHECKING:
    from xdist.remote import Producer

    from agent.delivery.store import Store
    from tests.unit.zenoh_site import Site

SCENARIOS = "tests/scenarios/"
COMPUTED = "tests/scenarios/test_online_"  # worlds of days and years, which wait for nothing
NICE = (
    15  # of processes that take other tests: a program that keeps pace with the clock gets the processor when it asks
)

# A shell starts a command in the background with SIGINT ignored, and nohup with SIGHUP: every child of the tests would
# ignore Ctrl-C and the end of its terminal too.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

# Examples follow from the test's own code, so that a failure comes again; time limits fail on a machine under load.
settings.register_profile("fieldcal", deadline=None, derandomize=True)
settings.load_profile("fieldcal")


class ScenariosBesideTheRest(LoadScopeScheduling):
    """Gives the scenarios to two of five processes, and what computes to the others, until one kind has run out.

    A scenario waits most of its time for a program that runs against the clock; meanwhile the other tests compute.
    """

    def _assign_work_unit(self, node: WorkerController) -> None:
        for_scenarios = takes_scenarios(node)
        wanted = next((scope for scope in self.workqueue if keeps_pace(scope) == for_scenarios), None)
        if wanted is not None:
            self.workqueue.move_to_end(wanted, last=False)
        super()._assign_work_unit(node)


def pytest_configure(config: pytest.Config) -> None:
    if "not slow" in config.getoption("markexpr"):
        config.pluginmanager.register(Quick())
    if not hasattr(config, "workerinput"):
        write_engine_id()


def write_engine_id() -> None:
    """The id of the engine stands in a file, as in a wheel: each program that a test starts would compute it, for a
    second of processor time. The file does not count any more as soon as a source is another one."""
    if identity.built()[0]:
        return
    path = Path(identity.__file__).with_name(identity.BUILT)
    written = path.with_suffix(f".{os.getpid()}")
    written.write_text(json.dumps(identity.computed()))
    written.replace(path)


def keeps_pace(scope: str) -> bool:
    """Whether the tests of a file start programs that keep pace with the clock."""
    return scope.startswith(SCENARIOS) and not scope.startswith(COMPUTED)


def takes_scenarios(node: WorkerController) -> bool:
    """Whether this process of xdist (gw0, gw1, ...) takes scenarios first."""
    return int(node.gateway.id.removeprefix("gw")) % 5 in (0, 2)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of a test marked `one_case`, all cases but the first are thorough; of one marked `two_cases`, all but the first
    two are nightly.

    Worlds of days and years and files with many slow tests come first: as one of the last they would keep one process
    busy while others have ended.
    """
    seen = Counter[str]()
    for item in items:
        two = item.get_closest_marker("two_cases") is not None
        if two or item.get_closest_marker("one_case"):
            item.add_marker("slow")
            name = item.nodeid.partition("[")[0]
            if seen[name]:
                item.add_marker("nightly" if two and seen[name] > 1 else "thorough")
            seen[name] += 1
        if item.get_closest_marker("nightly"):
            item.add_marker("thorough")
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (not item.nodeid.startswith(COMPUTED), -slow[item.path]))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays until the end: no garbage collection need look at it, then or later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling | None:
    return ScenariosBesideTheRest(config, log) if config.getvalue("dist") == "loadscope" else None


def pytest_configure_node(node: WorkerController) -> None:
    by_scope = node.config.getvalue("dist") == "loadscope"
    node.workerinput["nice"] = NICE if by_scope and not takes_scenarios(node) else 0


def pytest_sessionstart(session: pytest.Session) -> None:
    """What computes leaves the processor to what must keep pace with the clock."""
    os.nice(getattr(session.config, "workerinput", {"nice": 0})["nice"])


@pytest.fixture(autouse=True)
def _signals_as_before() -> Iterator[None]:
    """A run that a test makes in this process ends with its signals ignored, and so would every later child: a pool of
    processes then waits for ever for workers that it tells to end. A file to which the interpreter writes at a signal
    is closed with the run that opened it, and its number may be that of any other file then."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)}
    yield
    signal.set_wakeup_fd(-1)
    for number, handler in before.items():
        if handler is not None and signal.getsignal(number) is not handler:
            signal.signal(number, handler)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store, whose results count from 0."""
    from agent.delivery.store import Store

    store = Store(tmp_path, 0)
    yield store
    store.close()


@pytest.fixture
def site() -> Iterator[Site]:
    """A Zenoh router on this machine, for gateways and consumers."""
    from tests.unit.zenoh_site import Site

    site = Site()
    yield site
    site.kill()
