"""An exported recording in the programs that show it: Rerun's converter, and the MCAP reader of JavaScript.

Both are skipped where the program is missing. `rerun` comes with the package rerun-sdk. The packages of JavaScript are
looked for in .venv/node, where .ci/run puts them if npm is there.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.core.events import CalibrationUpdate
from agent.recording.reading import RecordingReader
from tests.unit.recorded_bench import record
from tests.unit.test_export import messages

RERUN, NODE = shutil.which("rerun"), shutil.which("node")
PACKAGES = Path(__file__).parents[2] / ".venv" / "node"
READER = Path(__file__).with_name("read_mcap.mjs")
RATE_HZ = 50.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("viewers") / "data"
    record(data, 41.0)
    return data / "fieldcal-000001.mcap"


@pytest.fixture(scope="module")
def plots(recording: Path) -> Path:
    path = recording.with_name("plots.mcap")
    assert run_cli(["export", str(recording), "--mcap", str(path), "--rate-hz", str(RATE_HZ)]) == 0
    return path


def printed(command: Sequence[str | Path], home: Path) -> str:
    """What a program prints that keeps its settings in `home`."""
    environment = os.environ | {"HOME": str(home), "NO_COLOR": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


@pytest.mark.skipif(RERUN is None, reason="rerun is not installed (package rerun-sdk)")
def test_rerun_makes_scalars_of_indications_accelerations_and_s(recording: Path, plots: Path, tmp_path: Path) -> None:
    assert RERUN is not None
    printed([RERUN, "analytics", "disable"], tmp_path)
    printed([RERUN, "mcap", "convert", plots, "-o", tmp_path / "plots.rrd"], tmp_path)
    rows: dict[str, int] = {}
    line = re.compile(r"with (\d+) rows .* - (/mems/\S+) - data columns: \[.*Scalars:scalars")
    for count, entity in line.findall(printed([RERUN, "rrd", "print", tmp_path / "plots.rrd"], tmp_path)):
        rows[entity] = rows.get(entity, 0) + int(count)
    sent = [topic for topic, _, _ in messages(plots)]
    assert rows["/mems/acceleration"] == sent.count("/mems/acceleration") > 40 * RATE_HZ
    assert rows["/mems/indication/position"] == sent.count("/mems/indication") > 40 * RATE_HZ
    assert rows["/mems/calibration/position"] == sent.count("/mems/calibration") >= 1
    at = ["-vvv", "--transposed", "--entity", "/mems/calibration/position", str(tmp_path / "plots.rrd")]
    [*_, numbers] = re.findall(r"\[((?:-?\d+\.\d+, ){3,})", printed([RERUN, "rrd", "print", *at], tmp_path))
    results = (result for step in RecordingReader(recording).steps() for result in step.results)
    newest = [result for result in results if isinstance(result, CalibrationUpdate)][-1]
    shown = [float(number) for number in numbers.removesuffix(", ").split(", ")]  # the first ones: it cuts long lists
    np.testing.assert_allclose(shown, np.ravel(newest.sensitivity)[: len(shown)], rtol=1e-12)


@pytest.mark.skipif(NODE is None, reason="node is not installed")
@pytest.mark.skipif(not (PACKAGES / "node_modules" / "@mcap").is_dir(), reason="@mcap/core is not in .venv/node")
def test_javascript_decodes_the_same(plots: Path, tmp_path: Path) -> None:
    assert NODE is not None
    found: dict[str, list[Any]] = json.loads(printed([NODE, READER, PACKAGES, plots], tmp_path))
    expected: dict[str, list[Any]] = {}
    for topic, t_utc_ns, content in messages(plots):
        expected.setdefault(topic, []).append(content | {"log_time": str(t_utc_ns)})
    assert set(expected) == {"/mems/acceleration", "/mems/indication", "/mems/calibration"}
    assert found == expected
