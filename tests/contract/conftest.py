"""On which kinds of adapter the drivers of chips are tested, with how many accesses of other programs, and when.

What adapters can do is one code for all chips: one chip is tested on each of them, the others on those that differ
most.
"""

from __future__ import annotations

import pytest

from hw.conformance.i2c import I2cContract
from hw.virtual.kernel import PLAIN
from hw.virtual.spi_bus import SPI

FOR_EACH_CHIP = (PLAIN, SPI)
ON_ALL = "TestAdxl355"
ACCESSES = 4  # of `what_another_program`


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`make test-quick` has two kinds of adapter and few accesses of other programs, `make test` the others for one
    chip, `make test-all` for each."""
    for item in items:
        if not isinstance(item, pytest.Function) or item.cls is None or not issubclass(item.cls, I2cContract):
            continue
        adapter = item.callspec.params["adapter"]
        access = int(str(item.callspec.params["seed"])) if "what_another_program" in item.name else 0
        if adapter not in FOR_EACH_CHIP or access >= ACCESSES:
            item.add_marker("slow" if item.cls.__name__ == ON_ALL else "thorough")
