"""A directory of engines from a stranger: nothing of it runs, is unpacked or imported because it is there."""

from __future__ import annotations

import hashlib
import io
import os
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.engine import known
from agent.engine.identity import ROOT
from agent.engine.known import KnownEngine, check_trusted, find_engine
from agent.engine.process import EngineError, EngineProcess
from agent.engine.wheel import LARGEST, EngineWheel, file_name, read_wheel, wheel_of

ID = "0123456789abcdef"
WRITES = "open({!r}, 'w').close()\n"
SOURCES = {name: (ROOT / name).read_bytes() for name in ("agent/__init__.py", "agent/engine/__init__.py")}


def hostile_wheel(mark: Path) -> bytes:
    """A wheel with the right name and id, whose every module makes a file when it is imported."""
    does = WRITES.format(str(mark)).encode()
    return wheel_of(1, ID, dict.fromkeys((*SOURCES, "agent/engine/entry.py"), does))


def zipped(members: dict[str, bytes]) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return written.getvalue()


def sparse(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(10 << 30)


# What stands in the directory under the right name. (how it is made, what is told)
CONTENTS: dict[str, tuple[Callable[[Path, Path], object], str]] = {
    "a wheel of wrong bytes": (lambda p, mark: p.write_bytes(hostile_wheel(mark)), "is that of no release"),
    "sitecustomize": (
        lambda p, mark: p.write_bytes(zipped({"sitecustomize.py": WRITES.format(str(mark)).encode()})),
        "is that of no release",
    ),
    "a program for zipimport": (
        lambda p, mark: p.write_bytes(zipped({"__main__.py": WRITES.format(str(mark)).encode()})),
        "is that of no release",
    ),
    "a script": (lambda p, mark: p.write_text(f"#!/bin/sh\ntouch {mark}\n"), "is that of no release"),
    "no bytes": (lambda p, _: p.write_bytes(b""), "is that of no release"),
    "a bomb of zeros": (lambda p, _: p.write_bytes(zipped({"agent/x.py": bytes(64 << 20)})), "is that of no release"),
    "a directory": (lambda p, _: p.mkdir(), "Is a directory"),
    "a pipe": (lambda p, _: os.mkfifo(p), "Not a regular file"),
    "a link to a device": (lambda p, _: p.symlink_to("/dev/zero"), "Not a regular file"),
    "a link to itself": (lambda p, _: p.symlink_to(p), "Too many levels of symbolic links"),
    "a link to a file of the user": (lambda p, _: p.symlink_to("/etc/passwd"), "is that of no release"),
    "10 GB": (lambda p, _: sparse(p), f"more than {LARGEST} bytes"),
}


@pytest.mark.parametrize("content", CONTENTS)
def test_hostile_content_is_named_and_does_nothing(content: str, tmp_path: Path) -> None:
    make, told = CONTENTS[content]
    engines, mark = tmp_path / "engines", tmp_path / "mark"
    engines.mkdir()
    make(engines / file_name(ID), mark)
    for name in ("sitecustomize.py", "usercustomize.py", "numpy.py", "agent.py"):
        (engines / name).write_text(WRITES.format(str(mark)))
    (engines / "evil.pth").write_text(f"import os; os.close(os.open({str(mark)!r}, os.O_CREAT))\n")
    before, begin = sorted(os.listdir(engines)), time.process_time()
    found = find_engine(ID, [engines], ["f" * 64])
    assert isinstance(found, str)
    assert str(engines / file_name(ID)) in found
    assert told in found
    assert time.process_time() - begin < 2
    assert sorted(os.listdir(engines)) == before
    assert not mark.exists()


@pytest.mark.parametrize(
    "engine", ["../../etc/passwd", "", "0", "/dev/zero", "0123456789ABCDEF", "0123456789abcdef\n", "a" * 999]
)
def test_id_in_a_recording_leads_to_no_other_file(engine: str, tmp_path: Path) -> None:
    told = find_engine(engine, [tmp_path], [])
    assert isinstance(told, str)
    assert "is not the id of an engine" in told


def test_trust_by_the_user_and_by_the_list_of_releases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = wheel_of(1, ID, SOURCES | {"agent/engine/entry.py": b""})
    sha256 = hashlib.sha256(data).hexdigest()
    stranger, empty = tmp_path / "stranger", tmp_path / "empty"
    stranger.mkdir()
    (stranger / file_name(ID)).write_bytes(hostile_wheel(tmp_path / "mark"))
    empty.mkdir()
    told = find_engine(ID, [empty], [])
    assert isinstance(told, str)
    assert f"is in none of: {empty}" in told
    (empty / file_name(ID)).write_bytes(data)
    assert isinstance(find_engine(ID, [stranger, empty], [sha256[1:]]), str)
    found = find_engine(ID, [stranger, empty], [sha256[:16]])  # the first directory has another one
    assert isinstance(found, EngineWheel)
    assert (found.sha256, found.source) == (sha256, str(empty / file_name(ID)))
    release = KnownEngine(1, ID, sha256, "0.3.0", "abc")
    monkeypatch.setattr(known, "known_engines", lambda: (release,))
    assert isinstance(find_engine(ID, [empty], []), EngineWheel)
    # The same bytes under the name of another engine are not that engine.
    other = "f" * 16
    (empty / file_name(other)).write_bytes(data)
    told = find_engine(other, [empty], [sha256])
    assert isinstance(told, str)
    assert f"this is the wheel of the engine 1-{ID}" in told


def test_trusted_bytes_that_are_no_engine_are_refused(tmp_path: Path) -> None:
    data = zipped({"agent/engine/engine.json": b"{}", "../../x.py": b""})
    (tmp_path / file_name(ID)).write_bytes(data)
    told = find_engine(ID, [tmp_path], [hashlib.sha256(data).hexdigest()])
    assert isinstance(told, str)
    assert "its member '../../x.py' has no place in an engine" in told


@pytest.mark.parametrize("text", ["", ID[:15], "x" * 16, "f" * 65, ID + "\n", f" {ID}"])
def test_trust_needs_digits_of_a_digest(text: str) -> None:
    with pytest.raises(ValueError, match="SHA-256"):
        check_trusted(text)


@pytest.mark.skipif(sys.platform != "linux", reason="the sandbox needs Linux")
def test_trusted_engine_that_makes_a_file_is_told_and_makes_none(tmp_path: Path) -> None:
    """The mark of the tests above is made by an import, once nothing keeps the wheel from being imported."""
    mark = tmp_path / "mark"
    wheel = read_wheel("a stranger", hostile_wheel(mark))
    with pytest.raises(EngineError, match="PermissionError"), EngineProcess(wheel):
        pass
    assert not mark.exists()
    wheel.unpack(tmp_path)
    exec(compile((tmp_path / "agent/__init__.py").read_bytes(), "agent", "exec"), {})
    assert mark.exists()
