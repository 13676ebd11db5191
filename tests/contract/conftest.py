"""On which kinds of adapter the drivers of chips are tested, with how many accesses of other programs, and when.

What adapters can do is one code for all chips: one chip is tested on each of them, the others on those that differ
most.
"""

from __future__ import annotations

import pytest

from hw.conformance.i2c import I2cContract
from hw.virtual.kernel import PLAIN, SMBUS_ONLY
from hw.virtual.spi_bus import SPI

AT_ONCE = (PLAIN, SPI)
FOR_EACH_CHIP = (*AT_ONCE, SMBUS_ONLY)
ON_ALL = "TestAdxl355"
ACCESSES_AT_ONCE, ACCESSES_FOR_EACH_CHIP = 4, 12  # of `what_another_program`


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`make test-quick` has two kinds of adapter, `make test` three for each chip and all for one; likewise with the
    accesses of other programs."""
    for item in items:
        if not isinstance(item, pytest.Function) or item.cls is None or not issubclass(item.cls, I2cContract):
            continue
        adapter = item.callspec.params["adapter"]
        access = int(str(item.callspec.params["seed"])) if "what_another_program" in item.name else 0
        if adapter not in AT_ONCE or access >= ACCESSES_AT_ONCE:
            item.add_marker("slow")
        if item.cls.__name__ != ON_ALL and (adapter not in FOR_EACH_CHIP or access >= ACCESSES_FOR_EACH_CHIP):
            item.add_marker("thorough")
