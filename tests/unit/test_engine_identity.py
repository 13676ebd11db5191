"""The name of the engine follows from what its code does, and all code that results depend on is part of it."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from agent.engine import identity
from agent.engine.identity import BUILT, ROOT, bare, digest, name, source_files

GOLDEN = ROOT / "tests/replay/golden/format-3/fieldcal-000001.mcap"
REPLAY = """
import sys
from pathlib import Path
from agent.core.pipeline import Pipeline
from agent.core.events import RunStart
from agent.recording.messages import decode, encode, schema_of, topic_of
from agent.recording.reading import RecordingReader
pipeline = None
for step in RecordingReader(Path(sys.argv[1])).steps():
    if isinstance(step.event, RunStart):
        pipeline = Pipeline.restore(step.event.config_json, step.event.snapshot)
    for output in pipeline.step(step.event):
        encode(step.event_sequence, output)
for name, module in sorted(sys.modules.items()):
    if name.partition(".")[0] in ("agent", "calib", "hw"):
        print(module.__file__)
"""


# Modules that read the file, for an engine that gets its messages from another process.
READER = {
    "agent/recording/limits.py",
    "agent/recording/reading.py",
    "agent/recording/records.py",
}


def sources() -> dict[str, bytes]:
    return {member: path.read_bytes() for member, path in source_files()}


@pytest.mark.slow
def test_modules_that_a_replay_loads_are_part_of_the_engine() -> None:
    ran = subprocess.run([sys.executable, "-c", REPLAY, GOLDEN], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = {Path(line).relative_to(ROOT).as_posix() for line in ran.stdout.splitlines()}
    assert {"agent/core/gate.py", "calib/state/state.py", "agent/config/whole.py"} <= loaded
    assert loaded - sources().keys() == READER


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"DIGITS_OF = 3\n", b"DIGITS_OF = 3  # a comment\n"),
        (b"def f():\n    return 1\n", b'def f():\n    """Says\n\n    much."""\n\n    return 1\n'),
        (b"class A:\n    x = 1\n", b'class A:\n    "#"\n    x = 1\n\n\n'),
        (b'__version__ = "1"\n', b'__version__ = "2"\n'),
    ],
)
def test_comments_docstrings_and_the_version_do_not_change_the_id(before: bytes, after: bytes) -> None:
    assert digest({"a.py": before}) == digest({"a.py": after})


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"x = 1\n", b"x = 2\n"),
        (b"x = '#1'\n", b"x = '#2'\n"),
        (b"if x:\n    y = 1\nz = 2\n", b"if x:\n    y = 1\n    z = 2\n"),
        (b"x = '''\na # b\n'''\n", b"x = '''\na\n'''\n"),
        (b"def f():\n    y = 1\n    'text'\n", b"def f():\n    y = 1\n    'other'\n"),
    ],
)
def test_code_changes_the_id(before: bytes, after: bytes) -> None:
    assert digest({"a.py": before}) != digest({"a.py": after})


def test_bare_source_means_the_same_as_the_source() -> None:
    import ast

    def without_docstrings(text: str) -> str:
        tree = ast.parse(text)
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list):
                node.body = [  # type: ignore[attr-defined]
                    s for s in body
                    if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
                    and not (isinstance(s, ast.Assign) and ast.unparse(s).startswith("__version__ ="))
                ]  # fmt: skip
        return ast.dump(tree)

    for path in (
        ROOT / "agent/core/pipeline.py",
        ROOT / "calib/model.py",
        ROOT / "hw/block.py",
        ROOT / "calib/__init__.py",
    ):
        source = path.read_bytes()
        assert without_docstrings(source.decode()) == without_docstrings(bare(source))


@pytest.mark.thorough
def test_an_engine_has_one_name_wherever_its_sources_lie() -> None:
    assert name().rpartition("-")[2] == digest(sources())


def test_a_built_installation_knows_its_id_until_a_source_changes(tmp_path: Path) -> None:
    """An engine of two modules, at another place: its id is another one than would be computed, so that its use is
    seen; then it is that of the sources as they are."""
    pipeline, core, change = "agent/core/pipeline.py", "agent/core/events.py", b"X = 2\n"
    files = {pipeline: b"from agent.core.events import X\n", core: b"X = 1\n"}
    files |= dict.fromkeys(["agent/__init__.py", "agent/core/__init__.py"], b"")
    unlike = {"agent/engine/__init__.py": b"", "agent/engine/identity.py": Path(identity.__file__).read_bytes()}
    digests = {member: hashlib.sha256(data).hexdigest() for member, data in files.items()}
    unlike["agent/engine/" + BUILT] = json.dumps({"id": "0123456789abcdef", "sources": digests}).encode()
    for member, data in {**files, **unlike}.items():
        (tmp_path / member).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / member).write_bytes(data)

    def said() -> str:
        script = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\nfrom agent.engine import identity\n"
        script += "print(identity.engine_id(), len(identity.source_files()))"
        return subprocess.run([sys.executable, "-I", "-c", script], capture_output=True, text=True, check=True).stdout

    assert said() == f"0123456789abcdef {len(files)}\n"
    (tmp_path / core).write_bytes(change)
    assert said() == f"{digest(files | {core: change})} {len(files)}\n"
