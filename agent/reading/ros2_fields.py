"""Numbers in messages of ROS: the definition of a message (ros2msg, ros1msg), and chosen fields of its bytes.

ROS 2 sends CDR. ROS 1 sends the same values little-endian without alignment; its `time` is a type of its own.

Definitions and messages are hostile: lengths are checked before use, and nothing recurses deeper than DEEPEST.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

NUMBERS = {
    "bool": "B", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
SIZES = {name: struct.calcsize(f"<{code}") for name, code in NUMBERS.items()}
DEEPEST, MOST_TYPES, LONGEST_ARRAY = 16, 256, 1 << 20
LITTLE, BIG = 1, 0  # second byte of a message in CDR; others are other encodings
_BREAK = re.compile(r"^=+\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?"
)
_STEP = re.compile(r"\.?([A-Za-z]\w*)|\[(\d+)\]")


class FieldError(ValueError):
    """A definition, a field or a message cannot be read. The message says what, and what is there."""


@dataclass(frozen=True, slots=True)
class Member:
    """A field of a message. `length`: None for one value, -1 for a sequence, else that of an array."""

    name: str
    kind: str
    length: int | None


Types = Mapping[str, Sequence[Member]]
ROS1_TIMES = {
    "time": [Member("sec", "uint32", None), Member("nsec", "uint32", None)],
    "duration": [Member("sec", "int32", None), Member("nsec", "int32", None)],
}
TIMES = ([("sec", "int32"), ("nanosec", "uint32")], [("sec", "uint32"), ("nsec", "uint32")])


def read_definition(name: str, text: str) -> tuple[str, Types]:
    """The name of the root type, and the fields of all types in a definition (ros2msg, ros1msg). Raises FieldError."""
    root = plain(name)
    types: dict[str, list[Member]] = dict(ROS1_TIMES)
    for k, block in enumerate(_BREAK.split(text)):
        title, _, rest = block.strip().partition("\n")
        if k and not title.startswith("MSG:"):
            raise FieldError(f"the definition of {name}: {title[:60]!r} stands where MSG: is expected")
        here = plain(title[4:].strip()) if k else root
        types[here] = _members(rest if k else block, here.partition("/")[0])
        if len(types) > MOST_TYPES:
            raise FieldError(f"the definition of {name} has more than {MOST_TYPES} types")
    return root, types


def _members(text: str, package: str) -> list[Member]:
    members = []
    for line in text.splitlines():
        words = line.partition("#")[0].strip()
        if not words:
            continue
        found = _FIELD.match(words)
        if found is None:
            raise FieldError(f"the line {words[:60]!r} of the definition is not understood")
        if found["constant"]:
            continue
        kind = found["type"]
        if kind not in NUMBERS and kind not in ("string", "wstring") and kind not in ROS1_TIMES:
            kind = plain(kind if "/" in kind else f"{package}/{kind}")
            kind = "std_msgs/Header" if kind == f"{package}/Header" and package != "std_msgs" else kind
        members.append(Member(found["name"], kind, _length(found["array"])))
    return members


def _length(array: str | None) -> int | None:
    if array is None:
        return None
    digits = array[1:-1]
    if not digits.isdigit():
        return -1
    if int(digits) > LONGEST_ARRAY:
        raise FieldError(f"an array of {digits} values is longer than {LONGEST_ARRAY}")
    return int(digits)


def plain(name: str) -> str:
    """pkg/msg/Type as pkg/Type."""
    return name.replace("/msg/", "/")


class Fields:
    """Reads chosen numbers of messages. `paths`: fields as in `linear_acceleration.x` or `samples[2].z`.

    A field of type builtin_interfaces/Time, or time of ROS 1, is a number of seconds. `serial`: cdr, or ros1. Raises
    FieldError where a path leads to no number.
    """

    def __init__(self, root: str, types: Types, paths: Sequence[str], serial: str = "cdr") -> None:
        self._root, self._types, self._paths = root, types, paths
        self._reader = _Ros1 if serial == "ros1" else _CdrReader
        self._wanted: dict[Any, Any] = {}
        for column, path in enumerate(paths):
            self._want(path, column)

    def _want(self, path: str, column: int) -> None:
        """Add a path to the tree of what is wanted; its leaf is a list of columns."""
        steps = _STEP.findall(path)
        if not steps or "".join(f"[{i}]" if i else f".{n}" for n, i in steps) not in (path, f".{path}"):
            raise FieldError(f"{path!r} is no field; write it as in linear_acceleration.x or samples[2].z")
        if len(steps) > DEEPEST:
            raise FieldError(f"{path!r} has more than {DEEPEST} parts")
        kind, length, node = self._root, None, self._wanted
        for k, (name, index) in enumerate(steps):
            if name:
                kind, length = self._member(kind, length, name, path)
            elif length is None or 0 <= length <= int(index):
                raise FieldError(f"{path!r}: [{index}] is not there; {self._kind(kind, length)} is")
            else:
                length = None
            key: str | int = name or int(index)
            if k == len(steps) - 1:
                break
            node = node.setdefault(key, {})
        if length is not None or not (kind in NUMBERS or self._is_time(kind)):
            raise FieldError(f"{path!r} is {self._kind(kind, length)}, which is no number{self._inside(kind)}")
        leaf = node.setdefault(key, {})
        leaf.setdefault(None, []).append(column)

    def _member(self, kind: str, length: int | None, name: str, path: str) -> tuple[str, int | None]:
        found = next((m for m in self._types.get(kind, ()) if m.name == name), None) if length is None else None
        if found is None:
            raise FieldError(f"{path!r}: there is no {name!r} in {self._kind(kind, length)}{self._inside(kind)}")
        return found.kind, found.length

    def _kind(self, kind: str, length: int | None) -> str:
        return kind if length is None else f"{kind}[{'' if length < 0 else length}]"

    def _inside(self, kind: str) -> str:
        names = [m.name for m in self._types.get(kind, ())]
        return f"; it has {', '.join(names[:24])}" if names else ""

    def _is_time(self, kind: str) -> bool:
        return [(m.name, m.kind) for m in self._types.get(kind, ())] in TIMES

    def read(self, data: bytes) -> list[float]:
        """The numbers of a message; NaN for an element that a sequence does not have. Raises FieldError."""
        values = [float("nan")] * len(self._paths)
        try:
            self._reader(data, self._types, values).take(self._root, self._wanted, 0)
        except (struct.error, IndexError):
            raise FieldError(f"a message of {len(data)} bytes ends before its last field {self._paths[-1]!r}") from None
        return values


class _CdrReader:
    """One message. Numbers are aligned to their size, counted from the fifth byte."""

    def __init__(self, data: bytes, types: Types, values: list[float]) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (BIG, LITTLE):
            raise FieldError(f"a message of {len(data)} bytes does not begin as CDR")
        self._data, self._types, self._values, self._at = data, types, values, 4
        self._order = "<" if data[1] == LITTLE else ">"

    def take(self, kind: str, wanted: Mapping[Any, Any], depth: int) -> None:
        """Pass over a value of this kind, and keep what is wanted of it."""
        columns = wanted.get(None)
        if kind in NUMBERS:
            value = self._number(kind)
            for column in columns or ():
                self._values[column] = value
            return
        if kind == "string":
            self._skip(int(self._number("uint32")), 1)
            return
        members = self._types.get(kind)
        if members is None or depth > DEEPEST:
            raise FieldError(f"the definition of {kind} is not in the file" if members is None else "it is too deep")
        if columns:
            value = self._number(members[0].kind) + 1e-9 * self._number(members[1].kind)
            for column in columns:
                self._values[column] = value
            return
        rest = len(wanted) if not depth else -1  # after the last field that is wanted, the message is not read
        for member in members:
            self._member(member, wanted.get(member.name, {}), depth + 1)
            rest -= member.name in wanted
            if rest == 0:
                return

    def _member(self, member: Member, wanted: Mapping[Any, Any], depth: int) -> None:
        if member.length is None:
            self.take(member.kind, wanted, depth)
            return
        n = int(self._number("uint32")) if member.length < 0 else member.length
        if n > len(self._data) - self._at:
            raise IndexError
        if member.kind in NUMBERS:
            size = SIZES[member.kind]
            begin = self._aligned(size) if n else self._at
            for index, leaf in wanted.items():
                if index < n:
                    self._at = begin + index * size
                    self.take(member.kind, leaf, depth)
            self._at = begin
            self._skip(n, size)
            return
        for index in range(n):
            self.take(member.kind, wanted.get(index, {}), depth)

    def _aligned(self, size: int) -> int:
        return self._at + (4 - self._at) % size

    def _number(self, kind: str) -> float:
        size = SIZES[kind]
        at = self._aligned(size)
        (value,) = struct.unpack_from(f"{self._order}{NUMBERS[kind]}", self._data, at)
        self._at = at + size
        return float(value)

    def _skip(self, n: int, size: int) -> None:
        self._at += n * size
        if self._at > len(self._data):
            raise IndexError


class _Ros1(_CdrReader):
    """One message of ROS 1: nothing is aligned."""

    def __init__(self, data: bytes, types: Types, values: list[float]) -> None:
        self._data, self._types, self._values, self._at, self._order = data, types, values, 0, "<"

    def _aligned(self, _: int) -> int:
        return self._at
