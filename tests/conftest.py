"""Settings of all tests."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

# As every entry point does, and for the same reason: one thread, the same bits on every machine.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from tests.unit.zenoh_site import Site

# A shell starts a command in the background with SIGINT ignored, and every child of the tests would ignore Ctrl-C too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples follow from the test's own code, so that a failure comes again; time limits fail on a machine under load.
settings.register_profile("fieldcal", deadline=None, derandomize=True)
settings.load_profile("fieldcal")


@pytest.fixture
def site() -> Iterator[Site]:
    """A Zenoh router on this machine, for gateways and consumers."""
    from tests.unit.zenoh_site import Site

    site = Site()
    yield site
    site.kill()
