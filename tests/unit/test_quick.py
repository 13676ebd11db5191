"""What keeps `make test-quick` quick."""

from __future__ import annotations

from typing import Literal

import pytest

from tests.quick import LIMIT_S, MOST_S, Quick


def report(nodeid: str, when: Literal["setup", "call", "teardown"], taken_s: float) -> pytest.TestReport:
    return pytest.TestReport(nodeid, ("", 0, ""), {}, "passed", None, when, user_properties=[("cpu_s", taken_s)])


def test_the_cases_of_a_test_count_together_and_a_busy_machine_is_forgiven() -> None:
    quick = Quick()
    for case in range(4):
        quick.pytest_runtest_logreport(report(f"a.py::test_a[{case}]", "teardown", MOST_S / 3))
        quick.pytest_runtest_logreport(report(f"a.py::test_a[{case}]", "call", 100.0))
        quick.pytest_runtest_logreport(report("a.py::test_b", "teardown", LIMIT_S / 4))
    assert quick.slow == ["a.py::test_a took 2.4 s of processor time: mark it `slow`, or make it smaller"]
