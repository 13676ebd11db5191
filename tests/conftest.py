"""Settings of all tests."""

from __future__ import annotations

import os
import signal

# As every entry point does, and for the same reason: one thread, the same bits on every machine.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from hypothesis import settings

# A shell starts a command in the background with SIGINT ignored, and every child of the tests would ignore Ctrl-C too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples follow from the test's own code, so that a failure comes again; time limits fail on a machine under load.
settings.register_profile("fieldcal", deadline=None, derandomize=True)
settings.load_profile("fieldcal")
