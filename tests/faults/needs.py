"""What the faults need of the machine. A test is skipped where something is missing, and names it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

TOOLS = {"strace": "strace", "gcc": "gcc", "mkfs.ext4": "e2fsprogs", "mkfs.xfs": "xfsprogs", "mount": "mount"}


def missing(*tools: str, root: bool = True) -> list[str]:
    """What is missing of these tools (of all, if none is named), root's rights and loop devices."""
    lacking = [f"{name} (package {TOOLS[name]})" for name in tools or TOOLS if shutil.which(name) is None]
    if root and os.geteuid() != 0:
        lacking.append("root")
    if root and not Path("/dev/loop-control").exists():
        lacking.append("/dev/loop-control")
    return lacking


def require(*tools: str, root: bool = False) -> None:
    """Skip the test where something is missing."""
    if lacking := missing(*tools, root=root):
        pytest.skip(f"needs {', '.join(lacking)}")
