"""The auditor's archive: everything with which recordings can be audited in ten years, without network.

It holds the engines, the program that audits, the hash-pinned wheels of all that these import, and an interpreter. For
the machine's own architecture that is the running interpreter with the shared libraries that it needs, down to the
loader of the C library, which a shell script calls: nothing is taken from the machine that audits but its kernel and
/bin/sh. For another architecture it is an interpreter that the user gives, as python-build-standalone makes them (a tar
file with bin/python3 and lib/python3.N in one directory); it uses the C library of the machine that audits.

pip evaluates the markers of a lock file for the interpreter that runs it (pypa/pip, issue 6117), so every interpreter
of an archive has the minor version of the running one.
"""

from __future__ import annotations

import compileall
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from py_compile import PycInvalidationMode

from agent.engine.wheel import EngineWheel, file_name

ARCHITECTURES = ("x86_64", "aarch64")
INDEX = "SHA256SUMS"
_PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
_PACKAGES = Path("lib", _PYTHON, "site-packages")  # in the directory of an architecture
_OLDEST_GLIBC, _NEWEST_GLIBC = 5, 36  # 2.5 is that of manylinux1, 2.36 that of Debian 12
_UNUSED = (
    "site-packages", "dist-packages", "__pycache__", "test", "tests", "idlelib", "tkinter", "_tkinter*", "turtledemo",
    "ensurepip", "lib2to3", "config-*",
)  # fmt: skip
_TESTS = re.compile(r"/tests?/")
_RESOLVED = re.compile(r"^\t(?:\S+ => )?(/\S+) \(0x", re.MULTILINE)  # a line of ldd

AUDIT = """#!/bin/sh
# Audits recordings with what is in this archive: ./audit DATA-DIRECTORY; ./audit --help
here=$(cd "${0%/*}" && pwd) || exit 1
[ -w /dev/shm ] || set -- --jobs 1 "$@"  # where several processes cannot share memory
for machine in x86_64 aarch64; do
  python=$here/$machine/bin/python3
  if [ -f "$python" ] && "$python" -I -S -c "" 2>&-; then
    exec "$python" -I -B -m agent audit --engines "$here/engines" "$@"
  fi
done
echo "audit: no interpreter in $here runs on this machine; README.md says which there are" >&2
exit 1
"""
PYTHON = """#!/bin/sh
# Starts the interpreter by the loader and the libraries of this archive, under the name of this script.
here=$(cd "${0%/*}/.." && pwd) || exit 1
exec "$here/lib/LOADER" --argv0 "$here/bin/python3" --library-path "$here/lib" "$here/bin/python3.bin" "$@"
"""
README = """# Archive of an auditor

    ./audit DATA-DIRECTORY       checks all recordings in a directory
    ./audit --help               says what else it can do
    sha256sum -c SHA256SUMS      checks this archive

`audit` needs a Linux kernel and /bin/sh. Nothing is installed, and nothing in the archive is changed.

| here | what |
| --- | --- |
| `engines/` | the engines: the code that results depend on, one wheel for each |
| `program/` | the program that audits |
| `requirements.lock` | versions and hashes of all packages that engines and program import |
| `wheels/` | these packages |
| `x86_64/`, `aarch64/` | interpreter, program and packages, ready to run |

"""


class ArchiveError(Exception):
    """The archive cannot be made. The message says what to do."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What an archive is made of. `program`: the wheel of fieldcal; `lock`: a requirements file with hashes.

    `wheelhouse`: a directory with all wheels, where there is no network. `interpreters`: tar files by architecture.
    """

    engines: Sequence[EngineWheel]
    program: Path
    lock: Path
    wheelhouse: Path | None
    interpreters: Mapping[str, Path]


def make_archive(target: Path, parts: Parts) -> list[str]:
    """Write the archive into a new directory; gives what is not in it. Raises ArchiveError, OSError."""
    if target.exists():
        raise ArchiveError(f"{target}: it is there already; an archive is made in a new directory")
    target.mkdir(parents=True)
    try:
        return _fill(target, parts)
    except BaseException:
        shutil.rmtree(target, ignore_errors=True)
        raise


def _fill(target: Path, parts: Parts) -> list[str]:
    for directory in ("engines", "program"):
        (target / directory).mkdir()
    for engine in parts.engines:
        (target / "engines" / file_name(engine.engine_id)).write_bytes(engine.data)
    program = Path(shutil.copy(parts.program, target / "program"))
    lock = Path(shutil.copy(parts.lock, target / "requirements.lock"))
    runnable = [machine for machine in ARCHITECTURES if _interpreter(target / machine, parts)]
    for machine in runnable:
        _install(program, target / machine / _PACKAGES)
    for machine in ARCHITECTURES:
        _fetch(machine, lock, parts.wheelhouse, target / "wheels" / machine)
        if machine in runnable:
            _make_runnable(target, machine, parts)
    _write_script(target / "audit", AUDIT)
    engines = "\n".join(f"- engine {engine.name}, SHA-256 {engine.sha256}" for engine in parts.engines)
    missing = [
        f"an interpreter for {machine}; --interpreter {machine}=FILE.tar.gz adds one"
        for machine in ARCHITECTURES
        if machine not in runnable
    ]
    absent = "".join(f"\nNot in this archive: {what}.\n" for what in missing)
    (target / "README.md").write_text(f"{README}{engines}\n{absent}")
    (target / INDEX).write_text(_index(target))
    return missing


def _interpreter(place: Path, parts: Parts) -> bool:
    """Put the interpreter of an architecture into its directory; False where there is none."""
    if (given := parts.interpreters.get(place.name)) is not None:
        _unpack_interpreter(given, place)
    elif place.name == platform.machine():
        _copy_interpreter(place)
    return place.exists()


def _make_runnable(target: Path, machine: str, parts: Parts) -> None:
    """Add the packages to an interpreter and, where the interpreter is the running one, the libraries of the system."""
    place = target / machine
    for wheel in sorted((target / "wheels" / machine).iterdir()):
        _install(wheel, place / _PACKAGES)
    if machine not in parts.interpreters:
        _copy_libraries(place)
    compileall.compile_dir(  # without the paths of this machine, and so that nothing is written at an audit
        place / "lib", quiet=2, stripdir=str(target), rx=_TESTS, invalidation_mode=PycInvalidationMode.UNCHECKED_HASH
    )
    if machine == platform.machine():
        _check_program(place / "bin" / "python3", parts)


def _check_program(python: Path, parts: Parts) -> None:
    """Run the program in the archive once: it must start, and its engine must be in the archive."""
    command = [str(python), "-I", "-B", "-m", "agent", "engines", "list", "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={})
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no output"])[-1]
        raise ArchiveError(f"{parts.program}: the program does not start from the archive: {last}")
    running = json.loads(done.stdout)["running"]
    if running not in [engine.name for engine in parts.engines]:
        raise ArchiveError(f"{parts.program}: it computes with the engine {running}, this program with another one")


def _fetch(machine: str, lock: Path, wheelhouse: Path | None, target: Path) -> None:
    """The locked packages for an architecture, by pip, which checks their hashes."""
    tags = [f"manylinux_2_{minor}_{machine}" for minor in range(_OLDEST_GLIBC, _NEWEST_GLIBC + 1)]
    tags += [f"manylinux{year}_{machine}" for year in ("2014", "2010", "1")]
    source = [] if wheelhouse is None else ["--no-index", "--find-links", str(wheelhouse)]
    command = [
        sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", *source,
        "--only-binary=:all:", "--require-hashes", "--no-deps", "--implementation", "cp", "--python-version",
        _PYTHON.removeprefix("python"), *(word for tag in tags for word in ("--platform", tag)),
        "--dest", str(target), "--requirement", str(lock),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or [done.stderr.strip()]
        raise ArchiveError(f"pip has not all wheels for {machine}: {errors[-1].removeprefix('ERROR: ')}")


def _install(wheel: Path, packages: Path) -> None:
    """Unpack a wheel as pip would, without its scripts and headers, which no import needs. zipfile keeps it inside."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(packages)
    except zipfile.BadZipFile as error:
        raise ArchiveError(f"{wheel.name}: no wheel: {error}") from None
    for data in packages.glob("*.data"):
        for inner in data.glob("*lib"):  # purelib, platlib
            shutil.copytree(inner, packages, dirs_exist_ok=True)
        shutil.rmtree(data)


def _unpack_interpreter(file: Path, place: Path) -> None:
    if not hasattr(tarfile, "data_filter"):
        raise ArchiveError(f"{file}: this Python cannot unpack a tar file safely; Python 3.11.4 and later can")
    beside = place.with_suffix(".unpacked")
    try:
        with tarfile.open(file) as archive:
            archive.extractall(beside, filter="data")
        found = next((path.parents[2] for path in beside.rglob(f"lib/{_PYTHON}/os.py")), None)
        if found is None or not (found / "bin/python3").exists():
            raise ArchiveError(f"{file}: it has no bin/python3 with lib/{_PYTHON}, the version of this Python")
        found.rename(place)
    except tarfile.TarError as error:
        raise ArchiveError(f"{file}: no tar file of an interpreter: {error}") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _check_own_loader() -> None:
    """The loader takes --argv0 since version 2.33 of the GNU C library (its file NEWS)."""
    library, version = platform.libc_ver()
    if library != "glibc" or tuple(map(int, version.split(".")[:2])) < (2, 33):
        raise ArchiveError(
            f"the loader of this machine's C library ({library or 'of another kind'} {version}) has no --argv0; "
            "make the archive where glibc is 2.33 or later (Debian 12), or give --interpreter"
        )


def _copy_interpreter(place: Path) -> None:
    """The running interpreter, with its standard library."""
    _check_own_loader()
    base = {"base": sys.base_prefix, "installed_base": sys.base_prefix}
    standard, dynamic = (Path(sysconfig.get_path(name, vars=base)) for name in ("stdlib", "platstdlib"))
    library = place / "lib" / _PYTHON
    for source in dict.fromkeys((standard, dynamic)):
        shutil.copytree(source, library, ignore=shutil.ignore_patterns(*_UNUSED), dirs_exist_ok=True)
    (place / "bin").mkdir()
    shutil.copy(os.path.realpath(sys.executable), place / "bin" / "python3.bin")


def _copy_libraries(place: Path) -> None:
    """The shared libraries of the system that anything in `place` needs, and the script that starts the interpreter."""
    ours = [place / "bin" / "python3.bin", *sorted(path for path in place.rglob("*.so*") if path.is_file())]
    needed = {path for path in _dependencies(ours) if not path.is_relative_to(place.resolve())}
    for path in sorted(needed):
        shutil.copy(path, place / "lib" / path.name)
    loader = next(path.name for path in sorted(needed) if path.name.startswith("ld-linux"))
    _write_script(place / "bin" / "python3", PYTHON.replace("LOADER", loader))


def _dependencies(binaries: Iterable[Path]) -> set[Path]:
    done = subprocess.run(["ldd", *binaries], capture_output=True, text=True, check=False)  # 1 where one needs none
    return {Path(name) for name in _RESOLVED.findall(done.stdout)}


def _write_script(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def _index(target: Path) -> str:
    """All files with their SHA-256, as `sha256sum -c` reads them."""
    lines = []
    for path in sorted(path for path in target.rglob("*") if path.is_file()):
        with open(path, "rb") as file:
            lines.append(f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {path.relative_to(target).as_posix()}\n")
    return "".join(lines)
