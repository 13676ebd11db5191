"""Tests that every driver must pass, as test classes to subclass, in this repository and in plug-ins. Needs pytest."""

import pytest

pytest.register_assert_rewrite("hw.conformance.sensor", "hw.conformance.i2c", "hw.conformance.serial")
