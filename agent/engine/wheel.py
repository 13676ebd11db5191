"""The wheel of an engine: its sources alone, the same bytes wherever it is built, and checked before it is unpacked.

Its members are compressed by bzip2: the output of zlib depends on which zlib the interpreter has, since zlib-ng writes
other bytes (zlib-ng/zlib-ng, issue 795).
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path

from agent.engine.identity import NUMBER, ROOT, engine_id, source_files

ENGINES = "engines"  # directory of a data directory that holds the wheels of the engines that wrote in it
LARGEST = 4 << 20  # bytes of a wheel; today's has 0.3 MB
LARGEST_UNPACKED = 16 << 20  # bytes of all members
MOST_MEMBERS = 1000
# What an engine imports, as in pyproject.toml.
REQUIREMENTS = ("msgspec>=0.20,<1", "numpy>=2.0,<2.5", "protobuf>=7.35.1,<8", "pydantic>=2.11,<3", "scipy>=1.15,<1.18")
ABOUT = "agent/engine/engine.json"  # the member that names the engine
PROCESS = ("agent/engine/__init__.py", "agent/engine/entry.py", "agent/engine/frames.py")  # no result depends on these
_MEMBER = re.compile(r"(agent|calib|hw)(/[a-z_][a-z0-9_]*)+\.(py|json)|fieldcal_engine-\d+\.dist-info/\w+")
_ID = re.compile(r"[0-9a-f]{16,64}")


class WheelError(Exception):
    """The bytes are no wheel of an engine. The message says why."""


@dataclass(frozen=True, slots=True)
class EngineWheel:
    """The wheel of an engine, read once and checked: nothing of it has been run. `source`: where it was found."""

    source: str
    data: bytes
    sha256: str
    number: int
    engine_id: str
    members: dict[str, bytes]

    @property
    def name(self) -> str:
        """`<number>-<id>`, as recordings and results carry it."""
        return f"{self.number}-{self.engine_id}"

    def unpack(self, directory: Path) -> None:
        """Write the members into an empty directory. Raises OSError."""
        for member, data in self.members.items():
            path = directory / member
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


def build() -> bytes:
    """The wheel of the running engine. Raises OSError, and RuntimeError where this Python has no bz2."""
    sources = {name: path.read_bytes() for name, path in source_files()}
    sources |= {name: (ROOT / name).read_bytes() for name in PROCESS}
    return wheel_of(NUMBER, engine_id(), sources)


def wheel_of(number: int, engine: str, sources: dict[str, bytes]) -> bytes:
    """The wheel of an engine with this number and id, from its sources by their names in the wheel."""
    info = f"fieldcal_engine-{number}.dist-info"
    about = {"number": number, "id": engine, "requirements": REQUIREMENTS, "sources": sorted(sources)}
    members = sources | {
        ABOUT: json.dumps(about, indent=1).encode(),
        f"{info}/METADATA": _metadata(number, engine).encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nGenerator: fieldcal\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    lines = [f"{name},sha256={_base64_sha256(data)},{len(data)}" for name, data in sorted(members.items())]
    members[f"{info}/RECORD"] = "\n".join([*lines, f"{info}/RECORD,,", ""]).encode()
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w") as archive:
        for name, data in sorted(members.items()):
            entry = zipfile.ZipInfo(name)  # of 1980-01-01
            entry.create_system, entry.external_attr = 3, (stat.S_IFREG | 0o644) << 16
            archive.writestr(entry, data, zipfile.ZIP_BZIP2, 9)
    return written.getvalue()


def read_wheel(source: str, data: bytes) -> EngineWheel:
    """The engine in the bytes of a wheel. Runs and unpacks nothing. Raises WheelError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if len(entries) > MOST_MEMBERS:
                raise WheelError(f"it has more than {MOST_MEMBERS} members")
            left = LARGEST_UNPACKED
            members: dict[str, bytes] = {}
            for entry in entries:
                _check(entry, members)
                with archive.open(entry) as member:
                    members[entry.filename] = member.read(left + 1)
                left -= len(members[entry.filename])
                if left < 0:
                    raise WheelError(f"its members have more than {LARGEST_UNPACKED} bytes")
        about = json.loads(members[ABOUT])
        number, engine = about["number"], about["id"]
    except WheelError:
        raise
    except Exception as error:  # of zipfile, its decompressors and json, which raise many kinds of exceptions
        raise WheelError(f"it is no wheel of an engine: {type(error).__name__}: {error}") from None
    if not isinstance(number, int) or not isinstance(engine, str) or not is_id(engine):
        raise WheelError(f"{ABOUT} does not name the engine")
    return EngineWheel(source, data, hashlib.sha256(data).hexdigest(), number, engine, members)


def is_id(text: str) -> bool:
    """Whether a text can be the id of an engine, and so a part of a file name."""
    return _ID.fullmatch(text) is not None


def file_name(engine: str) -> str:
    """The name under which the wheel of an engine is kept."""
    return f"{engine}.whl"


def _check(entry: zipfile.ZipInfo, before: dict[str, bytes]) -> None:
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG) or not _MEMBER.fullmatch(entry.filename) or entry.filename in before:
        raise WheelError(f"its member {entry.filename[:100]!r} has no place in an engine")


def _metadata(number: int, engine: str) -> str:
    lines = [
        "Metadata-Version: 2.1",
        "Name: fieldcal-engine",
        f"Version: {number}",
        f"Summary: The engine {number}-{engine} of fieldcal: all code that its results depend on",
        "License: Apache-2.0",
        "Requires-Python: >=3.11",
        *(f"Requires-Dist: {requirement}" for requirement in REQUIREMENTS),
    ]
    return "\n".join([*lines, ""])


def _base64_sha256(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
