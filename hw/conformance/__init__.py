"""What every driver must do, as test classes to subclass, here and in plug-ins. Needs pytest."""

import pytest

pytest.register_assert_rewrite("hw.conformance.sensor", "hw.conformance.i2c", "hw.conformance.serial")
