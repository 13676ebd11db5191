"""Keeps `make test-quick` quick: a test that takes much processor time, all its cases together, is marked `slow`."""

from __future__ import annotations

import os
from collections import defaultdict

import pytest

LIMIT_S = 0.2  # what takes more is marked `slow`
MOST_S = 9 * LIMIT_S  # what takes more fails; the first test imports libraries, and a busy or slow machine needs more
BEGAN_S = pytest.StashKey[float]()


def cpu_s() -> float:
    """Processor time of this process and of its children that have ended."""
    return sum(os.times()[:4])


class Quick:
    """Sums the processor time of each test. Processes of xdist measure; the one that they report to sums and judges."""

    def __init__(self) -> None:
        self.by_test: defaultdict[str, float] = defaultdict(float)

    @property
    def slow(self) -> list[str]:
        """The lines about tests that take too much."""
        return [
            f"{name} took {taken_s:.1f} s of processor time: mark it `slow`, or make it smaller"
            for name, taken_s in sorted(self.by_test.items()) if taken_s > MOST_S
        ]  # fmt: skip

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        item.stash[BEGAN_S] = cpu_s()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> None:
        if call.when == "teardown":
            item.user_properties.append(("cpu_s", cpu_s() - item.stash[BEGAN_S]))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            taken_s = dict(report.user_properties)["cpu_s"]
            assert isinstance(taken_s, float)
            self.by_test[report.nodeid.partition("[")[0]] += taken_s

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.slow and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self.slow:
            terminalreporter.write_line(line)
