"""A few ends of real programs; `python -m tests.faults.ends` has 500."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.ends import SEED, ends, table

pytestmark = pytest.mark.faults


def test_twelve_ends(tmp_path: Path) -> None:
    found = list(ends(tmp_path, 12, SEED))
    assert [one.moment for one in found].count("after VALID") == 6
    assert not [one for one in found if one.faults], table(found)
