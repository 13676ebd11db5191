"""Faults of the disk, in small numbers; `make faults` injects them in full number."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import disk
from tests.faults.needs import require

pytestmark = pytest.mark.faults


@pytest.mark.root
@pytest.mark.parametrize("kind", ["ext4", "xfs"])
def test_power_cut(tmp_path: Path, kind: str) -> None:
    require(f"mkfs.{kind}", "mount", root=True)
    outcome = disk.power_cut(tmp_path, kind, 4)
    assert outcome.good, outcome
    assert outcome.findings.restored >= 1, outcome


@pytest.mark.root
def test_full(tmp_path: Path) -> None:
    require("mkfs.ext4", "mount", root=True)
    outcome = disk.full(tmp_path)
    assert outcome.good, outcome


@pytest.mark.root
def test_read_only(tmp_path: Path) -> None:
    require("mkfs.ext4", "mount", root=True)
    outcome = disk.read_only(tmp_path)
    assert outcome.good, outcome


def test_sync_fails(tmp_path: Path) -> None:
    require("strace")
    outcome = disk.sync_fails(tmp_path)
    assert outcome.good, outcome


def test_slow(tmp_path: Path) -> None:
    require("strace")
    outcome = disk.slow(tmp_path)
    assert outcome.good, outcome


def test_slow_at_the_end(tmp_path: Path) -> None:
    require("strace")
    outcome = disk.slow_at_the_end(tmp_path)
    assert outcome.good, outcome
