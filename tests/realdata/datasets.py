"""Where the shared recordings lie: FIELDCAL_DATASETS, else beside the repository; tests skip where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("FIELDCAL_DATASETS", Path(__file__).parents[3] / "shared" / "datasets"))


def dataset(name: str) -> Path:
    """Directory of one set; skips the calling test where it is absent."""
    path = ROOT / name
    if not path.is_dir():
        pytest.skip(f"recorded data {path} are not there (set FIELDCAL_DATASETS)")
    return path
