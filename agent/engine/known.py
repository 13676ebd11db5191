"""Which engines are run: those that this program knows as releases, and those that the user names by their SHA-256.

    python -m agent.engine.known REVISION

adds the present engine to known.json, as a release does.

An engine is code. A wheel in the directory of a stranger is read as bytes, and its SHA-256 decides; until then nothing
of it is run, unpacked or imported. What is run later are the bytes that were hashed.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from agent import __version__
from agent.config.files import read_file
from agent.engine.identity import NUMBER, engine_id
from agent.engine.wheel import LARGEST, EngineWheel, WheelError, build, file_name, is_id, read_wheel

FEWEST_DIGITS = 16  # of a SHA-256 that a user states: nobody finds another wheel with these 64 bits
_LIST = Path(__file__).with_name("known.json")
_SHA256 = re.compile(rf"[0-9a-f]{{{FEWEST_DIGITS},64}}")


class KnownEngine(NamedTuple):
    """A release of the engine. `version` and `revision`: of the program that it was made from."""

    number: int
    id: str
    sha256: str
    version: str
    revision: str


@cache
def known_engines() -> tuple[KnownEngine, ...]:
    """The engines that this program knows as releases, the oldest first."""
    return tuple(KnownEngine(**entry) for entry in json.loads(_LIST.read_text("utf-8")))


def known_digests(engine: str) -> set[str]:
    """SHA-256 of the wheels of the releases with this id; they differ by comments alone."""
    return {known.sha256 for known in known_engines() if known.id == engine}


def check_trusted(text: str) -> str:
    """The SHA-256 that a user states, or its first digits, in lower case. Raises ValueError."""
    if not _SHA256.fullmatch(text.lower()):
        raise ValueError(f"{text!r}: state the SHA-256 of the engine's wheel, {FEWEST_DIGITS} to 64 hexadecimal digits")
    return text.lower()


def find_engine(engine: str, directories: Sequence[Path], trusted: Collection[str]) -> EngineWheel | str:
    """The engine with this id, from the first directory that has it and whose wheel is trusted; or why there is none.

    `trusted`: the results of `check_trusted`. The wheel in a directory is `<id>.whl`.
    """
    if not is_id(engine):
        return f"{engine[:100]!r} is not the id of an engine"
    reasons = []
    for directory in directories:
        path = directory / file_name(engine)
        try:
            data = read_file(path, LARGEST)
        except FileNotFoundError:
            continue
        except OSError as error:
            reasons.append(f"{path}: {error.strerror}")
            continue
        found = _trusted(path, data, engine, trusted)
        if not isinstance(found, str):
            return found
        reasons.append(found)
    if reasons:
        return "; ".join(reasons)
    return f"{file_name(engine)} is in none of: {', '.join(map(str, directories))}" if directories else "no directory"


def description(path: Path) -> dict[str, str]:
    """What can be said of a file without trust in it: its path and SHA-256, and which release it is; or a fault."""
    try:
        sha256 = hashlib.sha256(read_file(path, LARGEST)).hexdigest()
    except OSError as error:
        return {"path": str(path), "fault": error.strerror or str(error)}
    release = next((known for known in known_engines() if known.sha256 == sha256), None)
    name = {"engine": f"{release.number}-{release.id}", "version": release.version} if release else {}
    return {"path": str(path), "sha256": sha256, **name}


def _trusted(path: Path, data: bytes, engine: str, trusted: Collection[str]) -> EngineWheel | str:
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 not in known_digests(engine) and not any(sha256.startswith(digits) for digits in trusted):
        return (
            f"{path}: its SHA-256 {sha256} is that of no release, so it is not run; "
            f"if you know where it is from: --trust-engine {sha256}"
        )
    try:
        wheel = read_wheel(str(path), data)
    except WheelError as error:
        return f"{path}: {error}"
    return wheel if wheel.engine_id == engine else f"{path}: this is the wheel of the engine {wheel.name}"


def add_release(revision: str) -> None:
    """Add the running engine to the list, unless it is there. `revision`: of the program's sources."""
    add([KnownEngine(NUMBER, engine_id(), hashlib.sha256(build()).hexdigest(), __version__, revision)])


def add(engines: Sequence[KnownEngine]) -> None:
    """Add engines to the list, by their numbers, unless they are there."""
    new = [engine for engine in engines if engine.sha256 not in known_digests(engine.id)]
    listed = sorted([*known_engines(), *new], key=lambda engine: engine.number)
    _LIST.write_text(json.dumps([engine._asdict() for engine in listed], indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    add_release(sys.argv[1])
