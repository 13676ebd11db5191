"""The golden recordings: their directories, and the results that a replay gives.

`python -m tests.replay.golden_files` writes each expected.json anew. Run it only after a change that is meant to change
results.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from agent.core.pipeline import Pipeline
from agent.recording.fingerprint import fingerprint
from agent.recording.reading import RecordingReader
from agent.recording.replaying import Replay

FORMATS = sorted((Path(__file__).parent / "golden").iterdir())
RECORDING, STATE, EXPECTED = "fieldcal-000001.mcap", "state.sqlite", "expected.json"


def results_of(path: Path) -> list[dict[str, Any]]:
    """All results of a replay, in order, as they are after JSON encoding and decoding."""
    replay = Replay(Pipeline.restore, fingerprint(), elsewhere=0.0)
    file = replay.run(path)
    assert not file.refused, file.refused
    assert file.fault is None
    found = sorted([*replay.windows, *replay.calibrations], key=lambda result: result.sequence)
    return [json.loads(msgspec.json.encode({"what": type(r).__name__, **msgspec.structs.asdict(r)})) for r in found]


def config_of(path: Path) -> str:
    """The configuration in a recording's RunStart, as JSON text."""
    start = next(step.event for step in RecordingReader(path).steps())
    return str(start.config_json)  # type: ignore[union-attr] - the reader ensures that the first event is a RunStart


if __name__ == "__main__":
    for directory in FORMATS:
        results = results_of(directory / RECORDING)
        (directory / EXPECTED).write_text(json.dumps(results, indent=1) + "\n")
        print(directory / EXPECTED, len(results), "results")
