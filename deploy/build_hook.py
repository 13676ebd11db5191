"""Writes the id of the engine into a wheel of fieldcal, so that a start on a small computer need not compute it.

hatchling calls it (pyproject.toml). An editable installation gets no such file, because its sources change; the tests
write one (tests/conftest.py).
"""

from __future__ import annotations

import importlib.util
import json
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class EngineHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds agent/engine/built.json to a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before a wheel is built. `version`: "standard" or "editable"."""
        if version == "editable":
            return
        path = Path(self.root) / "agent/engine/identity.py"
        spec = importlib.util.spec_from_file_location("identity", path)
        assert spec is not None
        assert spec.loader is not None
        identity = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(identity)
        self._directory = tempfile.TemporaryDirectory()
        built = Path(self._directory.name) / identity.BUILT
        built.write_text(json.dumps(identity.computed(), indent=1) + "\n")
        build_data["force_include"][str(built)] = f"agent/engine/{identity.BUILT}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Called after the wheel was built."""
        if version != "editable":
            self._directory.cleanup()
