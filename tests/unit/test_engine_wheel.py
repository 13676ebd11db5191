"""The wheel of an engine: the same bytes from any place, and nothing but an engine is read as one."""

from __future__ import annotations

import base64
import bz2
import hashlib
import io
import os
import shutil
import stat
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from agent.engine.identity import ROOT, digest, engine_id, source_files
from agent.engine.wheel import LARGEST_UNPACKED, REQUIREMENTS, WheelError, build, read_wheel, wheel_of

BUILD = """
import sys
sys.path.insert(0, sys.argv[1])
from agent.engine.wheel import build
sys.stdout.buffer.write(build())
"""
SOURCES = {"agent/__init__.py": b"", "agent/engine/__init__.py": b"", "agent/engine/entry.py": b""}


@pytest.fixture(scope="module")
def own() -> bytes:
    return build()


@pytest.mark.thorough
def test_wheel_is_the_same_from_another_place_at_another_time(own: bytes, tmp_path: Path) -> None:
    for package in ("agent", "calib", "hw"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    for path in tmp_path.rglob("*"):
        path.chmod(0o700)
        os.utime(path, (1, 1))
    command = [sys.executable, "-c", BUILD, str(tmp_path)]
    other = subprocess.run(
        command, capture_output=True, check=True, cwd=tmp_path, env={"TZ": "Asia/Tokyo", "LC_ALL": "C"}
    )
    assert hashlib.sha256(other.stdout).hexdigest() == hashlib.sha256(own).hexdigest()


@pytest.mark.slow
def test_wheel_holds_the_sources_of_the_engine_and_is_small(own: bytes) -> None:
    assert len(own) < 600_000
    wheel = read_wheel("own", own)
    assert wheel.engine_id == digest({name: wheel.members[name] for name, _ in source_files()}) == engine_id()
    (record,) = (data for name, data in wheel.members.items() if name.endswith("RECORD"))
    listed = dict(line.rsplit(",", 2)[:2] for line in record.decode().splitlines())
    assert listed.keys() == wheel.members.keys()
    for name, data in wheel.members.items():
        sha256 = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
        assert listed[name] in ("sha256=" + sha256, "" if name.endswith("RECORD") else None)


def test_requirements_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(REQUIREMENTS) <= set(project["dependencies"])


def with_member(name: str, data: bytes = b"", mode: int = stat.S_IFREG | 0o644) -> bytes:
    written = io.BytesIO(wheel_of(1, "0" * 16, SOURCES))
    with zipfile.ZipFile(written, "a") as archive:
        entry = zipfile.ZipInfo(name)
        entry.create_system, entry.external_attr = 3, mode << 16
        archive.writestr(entry, data, zipfile.ZIP_BZIP2)
    return written.getvalue()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (with_member("../agent/x.py"), "no place in an engine"),
        (with_member("/etc/x.py"), "no place in an engine"),
        (with_member("agent/../../x.py"), "no place in an engine"),
        (with_member("agent\\x.py"), "no place in an engine"),
        (with_member("sitecustomize.py"), "no place in an engine"),
        (with_member("agent.pth"), "no place in an engine"),
        (with_member("agent/core/native.so"), "no place in an engine"),
        (with_member("numpy/__init__.py"), "no place in an engine"),
        (with_member("agent/x.py/"), "no place in an engine"),
        (with_member("agent/link.py", b"/etc/passwd", stat.S_IFLNK | 0o777), "no place in an engine"),
        (with_member("agent/pipe.py", b"", stat.S_IFIFO | 0o644), "no place in an engine"),
        (with_member("agent/zeros.py", bytes(LARGEST_UNPACKED)), "its members have more than"),
        (wheel_of(1, "0" * 16, SOURCES | {f"agent/m{n}.py": b"" for n in range(1000)}), "more than 1000 members"),
        (wheel_of(1, "../../x", SOURCES), "does not name the engine"),
        (wheel_of(1, "0" * 16, SOURCES)[:-30], "it is no wheel of an engine: BadZipFile"),
        (b"", "it is no wheel of an engine"),
        (bz2.compress(bytes(1 << 20)), "it is no wheel of an engine"),
    ],
)
def test_what_is_no_engine_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(WheelError, match=reason):
        read_wheel("here", data)


@pytest.mark.filterwarnings("ignore:Duplicate name")  # zipfile warns when it writes it
def test_second_member_of_a_name_is_refused() -> None:
    with pytest.raises(WheelError, match="no place in an engine"):
        read_wheel("here", with_member("agent/__init__.py", b"import os"))
