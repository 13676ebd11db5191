"""Whether an agent runs on a data directory."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from agent.delivery.opening import LOCK_NAME


def agent_runs(data_dir: Path) -> bool:
    """Whether a process holds the lock of a data directory."""
    try:
        descriptor = os.open(data_dir / LOCK_NAME, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
