"""On which kinds of adapter the drivers of chips are tested, with how many accesses of other programs, and when.

What adapters can do is one code for all chips: one chip is tested on each of them, the others on those that differ
most and on one of the rest.
"""

from __future__ import annotations

from collections import defaultdict
from zlib import crc32

import pytest

from hw.conformance.i2c import I2cContract
from hw.virtual.kernel import PLAIN, Adapter
from hw.virtual.spi_bus import SPI, Controller

FOR_EACH_CHIP = (PLAIN, SPI)
ON_ALL = "TestAdxl355"
ACCESSES, MORE_ACCESSES = 4, 12  # of `what_another_program`


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """`make test-quick` has two kinds of adapter and few accesses of other programs, `make test` the others for one
    chip, `make test-all` more accesses, and `make nightly` one more kind for each chip."""
    methods = [item for item in items if isinstance(item.parent, pytest.Class) and isinstance(item, pytest.Function)]
    chips = [item for item in methods if issubclass(item.cls or object, I2cContract)]
    others: defaultdict[str, list[str]] = defaultdict(list)
    for item in chips:
        if (adapter := item.callspec.params["adapter"]) not in FOR_EACH_CHIP:
            others[item.cls.__name__].append(name_of(adapter))
    own = {chip: sorted(set(names))[crc32(chip.encode()) % len(set(names))] for chip, names in others.items()}
    left_out = []
    for item in chips:
        chip, adapter = item.cls.__name__, item.callspec.params["adapter"]
        access = int(str(item.callspec.params["seed"])) if "what_another_program" in item.name else 0
        if adapter in FOR_EACH_CHIP and access < ACCESSES:
            continue
        more = adapter not in FOR_EACH_CHIP or access >= MORE_ACCESSES
        if chip == ON_ALL:
            item.add_marker("thorough" if more and "what_another_program" in item.name else "slow")
        else:
            item.add_marker("nightly" if more else "thorough")
        of_another = adapter not in FOR_EACH_CHIP and name_of(adapter) != own[chip]
        if chip != ON_ALL and (of_another or access >= MORE_ACCESSES):
            left_out.append(item)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        left = set(left_out)
        items[:] = [item for item in items if item not in left]


def name_of(adapter: object) -> str:
    """The name of a kind of adapter, or of a controller of SPI."""
    assert isinstance(adapter, Adapter | Controller)
    return adapter.name
