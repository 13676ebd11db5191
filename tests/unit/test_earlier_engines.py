"""Engines of earlier revisions are built from the history, the same bytes each time; or the reason is told."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import pytest

from agent.engine.identity import NUMBER, ROOT
from agent.engine.known import known_engines
from agent.engine.wheel import read_wheel
from deploy.engines import earlier
from deploy.engines.earlier import REVISIONS, NoEngineError, NoHistoryError, Revision, build, keep

LOOKED = subprocess.run(["git", "cat-file", "-e", REVISIONS[0].commit], cwd=ROOT, capture_output=True, check=False)
with_history = pytest.mark.skipif(LOOKED.returncode != 0, reason="the history of the repository is not here")


def test_the_program_knows_the_engines_of_the_table() -> None:
    known = {Revision(engine.number, engine.revision, engine.version) for engine in known_engines()}
    assert set(REVISIONS) <= known
    assert {revision.number for revision in known} >= set(range(1, NUMBER)), (
        "an engine before the present one is missing"
    )


@pytest.mark.slow
@with_history
def test_an_engine_has_the_known_bytes_wherever_and_however_often_it_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = known_engines()[0]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    settings = {"core.autocrlf": "true", "tar.umask": "077"}
    monkeypatch.setenv("GIT_CONFIG_COUNT", str(len(settings)))
    for number, (key, value) in enumerate(settings.items()):
        monkeypatch.setenv(f"GIT_CONFIG_KEY_{number}", key)
        monkeypatch.setenv(f"GIT_CONFIG_VALUE_{number}", value)
    wheel = keep(REVISIONS[0], tmp_path / "engines")
    assert (wheel.name, wheel.sha256) == (f"1-{known.id}", known.sha256)
    assert read_wheel("", (tmp_path / "engines" / f"{known.id}.whl").read_bytes()).sha256 == known.sha256


@with_history
@pytest.mark.parametrize(
    ("commit", "reason"),
    [
        ("2a2c6a5599a8", "it has no pipeline, so it recorded no results"),
        ("7de5b9d1c9f4", "it does not run here: .* No module named 'agent.channel'"),
    ],
)
def test_a_revision_without_an_engine_is_told(commit: str, reason: str) -> None:
    with pytest.raises(NoEngineError, match=reason):
        keep(Revision(0, commit, ""), None)


def test_a_missing_history_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(earlier, "ROOT", tmp_path)
    with pytest.raises(NoHistoryError, match="not a git repository"):
        build(REVISIONS[0].commit, 1)
