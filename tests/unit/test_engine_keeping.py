"""A data directory keeps the wheel of the engine that writes in it."""

from __future__ import annotations

import hashlib
import logging
import os
import resource
from pathlib import Path

import pytest

from agent.engine import keeping, known
from agent.engine.identity import engine_id
from agent.engine.keeping import keep_engine
from agent.engine.known import KnownEngine, find_engine
from agent.engine.wheel import ENGINES, EngineWheel, build, file_name


def kept(directory: Path) -> Path:
    return directory / ENGINES / file_name(engine_id())


@pytest.mark.slow
def test_wheel_is_written_once_and_found_by_an_audit(tmp_path: Path) -> None:
    sha256 = keep_engine(tmp_path)
    path = kept(tmp_path)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    found = find_engine(engine_id(), [tmp_path / ENGINES], [sha256])
    assert isinstance(found, EngineWheel)
    before = path.stat()
    assert keep_engine(tmp_path) == sha256
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    path.write_bytes(path.read_bytes()[:-1])  # a power cut on a file system without order
    assert keep_engine(tmp_path) == sha256
    assert path.read_bytes() == build()
    assert os.listdir(path.parent) == [path.name]


def test_release_with_the_same_id_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It differs by comments alone, and signed texts name its digest."""
    path = kept(tmp_path)
    path.parent.mkdir()
    path.write_bytes(b"a wheel with other comments")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setattr(known, "known_engines", lambda: (KnownEngine(1, engine_id(), sha256, "0.3.0", "abc"),))
    assert keep_engine(tmp_path) == sha256
    assert path.read_bytes() == b"a wheel with other comments"


@pytest.mark.slow
def test_directory_that_cannot_be_written_is_told_and_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ENGINES).write_text("")  # a file where the directory should be
    with caplog.at_level(logging.WARNING):
        assert keep_engine(tmp_path) == hashlib.sha256(build()).hexdigest()
    (line,) = caplog.messages
    assert line.startswith(f"the engine of this run is not kept: {kept(tmp_path)}: ")

    def without_bz2() -> bytes:
        raise RuntimeError("Compression requires the (missing) bz2 module")

    monkeypatch.setattr(keeping, "build", without_bz2)
    assert keep_engine(tmp_path) == ""
    assert "its wheel cannot be made: Compression requires" in caplog.messages[-1]


@pytest.mark.slow
def test_disk_that_is_full_is_left_as_it_was(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        assert keep_engine(tmp_path) == hashlib.sha256(build()).hexdigest()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "is not kept" in caplog.text
    assert os.listdir(tmp_path / ENGINES) == []


@pytest.mark.slow
def test_release_is_added_to_the_list_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known, "_LIST", tmp_path / "known.json")
    known.known_engines.cache_clear()
    (tmp_path / "known.json").write_text("[]")
    try:
        for _ in range(2):
            known.add_release("abc123")
            known.known_engines.cache_clear()
        (release,) = known.known_engines()
        assert (release.id, release.revision) == (engine_id(), "abc123")
        assert known.known_digests(engine_id()) == {hashlib.sha256(build()).hexdigest()}
        assert known.known_digests("0" * 16) == set()
    finally:
        known.known_engines.cache_clear()
