"""`fieldcal engines`: what is in a directory, and an archive from which an audit starts by /bin/sh alone.

The interpreters are shell scripts here. deploy/audit_in_empty_root.sh runs an audit from a true archive.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from agent.engine.identity import engine_id, name
from agent.engine.keeping import keep_engine
from agent.engine.known import known_engines
from agent.engine.wheel import ENGINES, file_name

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the command needs Linux")
PYTHON = f"python3.{sys.version_info.minor}"
# Answers as the program would: `engines list --json -`, and its own arguments for all else.
INTERPRETER = f"""#!/bin/sh
case "$*" in *" -c "*) ;; *"engines list"*) echo '{{"running": "{name()}"}}';; *) echo "$0 $*";; esac
"""


def tar(path: Path, members: dict[str, bytes | str]) -> Path:
    """A tar file; a text is the target of a symbolic link."""
    with tarfile.open(path, "w:gz") as archive:
        for member, content in members.items():
            entry = tarfile.TarInfo(member)
            if isinstance(content, str):
                entry.type, entry.linkname = tarfile.SYMTYPE, content
                archive.addfile(entry)
                continue
            entry.size, entry.mode = len(content), 0o755
            archive.addfile(entry, io.BytesIO(content))
    return path


def wheel(path: Path, members: dict[str, bytes]) -> Path:
    """A wheel with these members."""
    project, version = path.name.split("-")[:2]
    info = f"{project}-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {project}\nVersion: {version}\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
    return path


@pytest.fixture
def given(tmp_path: Path) -> dict[str, Path]:
    """What an archive is made of: one package, one program, one interpreter for both architectures."""
    (tmp_path / "wheels").mkdir()
    members = {"tiny.py": b"", "tiny-1.data/purelib/inner.py": b"", "tiny-1.data/scripts/tiny": b""}
    package = wheel(tmp_path / "wheels/tiny-1-py3-none-any.whl", members)
    lock = tmp_path / "requirements.lock"
    lock.write_text(f"tiny==1 --hash=sha256:{hashlib.sha256(package.read_bytes()).hexdigest()}\n")
    tree: dict[str, bytes | str] = {f"python/lib/{PYTHON}/os.py": b"", "python/bin/python3": INTERPRETER.encode()}
    return {
        "wheels": package.parent,
        "program": wheel(tmp_path / "fieldcal-9-py3-none-any.whl", {"agent/__init__.py": b""}),
        "lock": lock,
        "interpreter": tar(tmp_path / "python.tar.gz", tree),
    }


def made(target: Path, given: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """(exit status, output) of `fieldcal engines archive`."""
    interpreters = [f"--interpreter={machine}={given['interpreter']}" for machine in ("x86_64", "aarch64")]
    options = [f"--{option}={given[option]}" for option in ("wheels", "program", "lock")]
    status = run_cli(["engines", "archive", "-o", str(target), *options, *interpreters])
    told = capsys.readouterr()
    return status, told.out + told.err


@pytest.mark.thorough
def test_archive_holds_all_and_audits_by_sh_alone(
    tmp_path: Path, given: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "archive"
    status, told = made(target, given, capsys)
    assert status == 0, told
    assert f"{target}: with the engines {name()}" in told
    for release in known_engines():  # whose wheels are not given
        assert release.id == engine_id() or f"not in it: engine {release.number}-{release.id}" in told
    sums = (target / "SHA256SUMS").read_text().splitlines()
    listed = {name: digest for digest, name in (line.split("  ") for line in sums)}
    files = {path.relative_to(target).as_posix(): path for path in target.rglob("*") if path.is_file()}
    assert listed == {
        member: hashlib.sha256(path.read_bytes()).hexdigest() for member, path in files.items() if member in listed
    }
    assert files.keys() - listed.keys() == {"SHA256SUMS"}
    for machine in ("x86_64", "aarch64"):
        packages = f"{machine}/lib/{PYTHON}/site-packages"
        assert {f"{packages}/{module}.py" for module in ("tiny", "inner", "agent/__init__")} <= files.keys()
        assert f"wheels/{machine}/tiny-1-py3-none-any.whl" in files
    assert f"engines/{file_name(engine_id())}" in files
    assert not [member for member in files if "tiny-1.data" in member]
    done = subprocess.run(["/bin/sh", target / "audit", "a b"], capture_output=True, text=True, env={}, cwd="/")
    jobs = "" if os.access("/dev/shm", os.W_OK) else "--jobs 1 "
    assert done.stdout == f"{target}/x86_64/bin/python3 -I -B -m agent audit --engines {target}/engines {jobs}a b\n"
    # The machine of the other architecture: the first interpreter cannot run.
    (target / "x86_64/bin/python3").write_bytes(b"\x7fELF of another machine")
    done = subprocess.run([target / "audit"], capture_output=True, text=True, env={})
    assert done.stdout.startswith(f"{target}/aarch64/bin/python3 -I")
    (target / "aarch64/bin/python3").unlink()
    done = subprocess.run([target / "audit"], capture_output=True, text=True, env={})
    assert (done.returncode, done.stderr.startswith("audit: no interpreter in")) == (1, True)
    assert made(target, given, capsys) == (
        2,
        f"fieldcal engines archive: {target}: it is there already; an archive is made in a new directory\n",
    )


BASE = f"python/lib/{PYTHON}/os.py"


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("part", "content", "told"),
    [
        ("lock", b"tiny==1 --hash=sha256:" + b"0" * 64, "pip has not all wheels for x86_64"),
        ("program", b"no zip", "fieldcal-9-py3-none-any.whl: no wheel: File is not a zip file"),
        ("interpreter", b"no tar", "no tar file of an interpreter"),
        ("interpreter", {"lib/python3.1/os.py": b"", "bin/python3": b""}, f"it has no bin/python3 with lib/{PYTHON}"),
        ("interpreter", {BASE: b""}, "it has no bin/python3"),
        ("interpreter", {BASE: b"", "../outside": b""}, "no tar file of an interpreter: .*outside"),
        ("interpreter", {BASE: b"", "python/bin/python3": "/bin/sh"}, "no tar file of an interpreter: .*link"),
        ("interpreter", {BASE: b"", "python/bin/python3": b"#!/bin/sh\necho no >&2; exit 1"}, "does not start .*: no"),
        ("interpreter", {BASE: b"", "python/bin/python3": b'#!/bin/sh\necho \'{"running": "1-0"}\''}, "the engine 1-0"),
    ],
)  # fmt: skip
def test_archive_that_cannot_be_made_is_told_and_leaves_nothing(
    part: str, content: bytes | dict[str, bytes | str], told: str,
    tmp_path: Path, given: dict[str, Path], capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if isinstance(content, dict):
        tar(given[part], content)
    else:
        given[part].write_bytes(content)
    status, output = made(tmp_path / "archive", given, capsys)
    assert status == 2
    assert re.search(told, output), output
    assert output.count("\n") == 1
    assert not (tmp_path / "archive").exists()


def test_engines_of_a_data_directory_are_listed_and_not_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sha256 = keep_engine(tmp_path)
    (tmp_path / ENGINES / "evil.pth").write_text(f"import os; os.mkdir({str(tmp_path / 'mark')!r})")
    (tmp_path / ENGINES / "a\x1b[2Jname.whl").mkdir()
    assert run_cli(["engines", "list", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"this program computes with the engine {name()}\n")
    assert sha256 in out
    assert "evil.pth: no release; SHA-256" in out
    assert "Is a directory" in out
    assert "\x1b" not in out
    assert run_cli(["engines", "list", "--json", "-", str(tmp_path / ENGINES)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["running"] == name()
    assert len(told["files"]) == 3
    assert not (tmp_path / "mark").exists()
    for argument in ("x86_64", "x86_64=/nowhere", "sparc=/etc/passwd"):
        command = ["engines", "archive", "-o", "x", "--program", "/etc/passwd", "--lock", "/etc/passwd"]
        assert run_cli([*command, "--interpreter", argument]) == 2
        assert "state x86_64 or aarch64, '=' and a file" in capsys.readouterr().err
