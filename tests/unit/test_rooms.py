"""What the deterministic core loads; import-linter holds who imports whom."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from agent.config.knowledge import Knowledge

ROOT = Path(__file__).parents[2]
FORBIDDEN = ("sqlite3", "zenoh", "mcap", "serial", "click")
WALK = """
import importlib, pkgutil, sys
import agent.core, calib
for package in (agent.core, calib):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
print(*sorted(sys.modules))
"""


@pytest.mark.thorough
def test_the_core_and_the_library_load_no_input_or_output() -> None:
    run = subprocess.run([sys.executable, "-c", WALK], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = run.stdout.split()
    assert "agent.core.pipeline" in loaded
    assert "calib.paper.method3" in loaded
    assert [name for name in loaded if name.partition(".")[0] in FORBIDDEN] == []


@pytest.mark.thorough
def test_no_text_of_the_library_names_an_option_a_command_or_a_setting_of_the_agent() -> None:
    """Names in `...` are arguments of functions; the command line writes them as its options."""
    settings = [rf"\b{section}\.{field}\b" for section, of in Knowledge.model_fields.items()
                for field in of.annotation.model_fields]  # type: ignore[union-attr]  # fmt: skip
    of_the_agent = re.compile("|".join([r"--[a-z]", "fieldcal", r"\btoml\b", r"\bagent\b", *settings]), re.IGNORECASE)
    assert of_the_agent.search("state prior.u_corner_hz")
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value}"
        for path in sorted((ROOT / "calib").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and of_the_agent.search(node.value)
    ]
    assert found == []


@pytest.mark.thorough
def test_a_run_loads_neither_virtual_worlds_nor_what_is_done_at_a_desk() -> None:
    """Beside them, `fieldcal run` asks once, before devices open, what stated positions determine (agent.bench)."""
    code = "import sys, agent.cli.run, agent.acquisition.service, agent.recording.device\nprint(*sorted(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = run.stdout.split()
    assert "agent.core.pipeline" in loaded
    desk = re.compile(
        r"hw\.(virtual|conformance)\b"
        r"|agent\.(bench|calibrate|certificate|export|fleet|monitor|reading|report|site_watch)\b"
        r"|calib\.(adjustment|paper|recorded|site_adjustment|site_watch|visit)\b"
    )
    assert desk.match("hw.virtual.bench")
    assert [name for name in loaded if desk.match(name)] == []


@pytest.mark.thorough
def test_a_run_loads_nothing_while_devices_are_read() -> None:
    """What numpy loads at the first use of a function costs memory, and time in which no device is read."""
    code = (
        "import sys, agent.cli.run, agent.acquisition.service, agent.recording.device\n"
        "from agent.cli.main import run_cli\n"
        "from tests.replay.golden_files import FORMATS, RECORDING\n"
        "before = set(sys.modules)\n"
        "run_cli(['replay', str(FORMATS[-1] / RECORDING)])\n"
        "print(*sorted(name for name in set(sys.modules) - before if name.startswith('numpy')))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "from its own snapshot" in run.stdout
    assert run.stdout.splitlines()[-1] == ""


@pytest.mark.slow
def test_calibrate_from_text_loads_no_configuration_and_no_scipy() -> None:
    """To load them takes a quarter of a second."""
    code = "import sys, agent.cli.calibrate\nprint(*sorted({name.partition('.')[0] for name in sys.modules}))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = run.stdout.split()
    assert "numpy" in loaded
    assert {"pydantic", "scipy", "obspy", "cryptography"}.isdisjoint(loaded)
