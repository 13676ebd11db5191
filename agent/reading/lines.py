"""The lines of a text file: its encoding, the ends of its lines, and what a power cut left."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from agent.reading.source import Progress, TableError

HEAD_BYTES = 1 << 16  # the table must begin in these
CHUNK_BYTES = 1 << 23
LONGEST_LINE = 1 << 20
FEWEST_LINES = 3  # before a byte 0: a power cut leaves such bytes behind the text, other formats begin with them
MOST_CONTROL = 0.02  # part of the bytes of a text; of bytes without order, a tenth are such
_CONTROL = re.compile(rb"[\x01-\x08\x0e-\x19\x1c-\x1f\x7f]")  # of no text: no end of a line, no page, no escape
_END = re.compile(r"\r*\n|\r")
_ENDS = re.compile(rb"\r*\n|\r")


@dataclass(frozen=True, slots=True)
class Text:
    """A text file. `encoding`: of its characters. `head`: its first lines. `unended`: the last line where it has no
    end, else "". `zeros`: whether bytes 0 stand behind the last line."""

    path: Path
    encoding: str
    head: tuple[str, ...]
    unended: str
    zeros: bool


def text_of(path: Path) -> Text:
    """Find how the file writes its lines. Raises TableError."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            if not head.strip(b"\0\r\n\t "):
                raise TableError(f"{path}, line 1: the file is empty; expected a header such as time_s,vx,vy,vz")
            encoding = _encoding(path, head)
            tail = _tail(file).decode(_bare(encoding, head), "replace")
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    lines = _END.split(codecs.getincrementaldecoder(encoding)(errors="replace").decode(head))
    if len(head) == HEAD_BYTES:
        lines = lines[:-1]
    return Text(path, encoding, tuple(lines), _END.split(tail.rstrip("\0"))[-1].strip(), tail.endswith("\0"))


def blocks(text: Text, progress: Progress | None = None) -> Iterator[bytes]:
    """Yield whole lines as ASCII-compatible bytes, each ended by one newline, from the first line of the file.

    A last line without end is left out: where it was cut off, "-1234" may be "-12".

    Raises TableError where a line is too long.
    """
    wide = text.encoding.startswith("utf-16")
    decode = codecs.getincrementaldecoder(text.encoding)("replace").decode if wide else None
    rest = b""
    with text.path.open("rb") as file:
        while data := file.read(CHUNK_BYTES):
            if progress is not None:
                progress(len(data))
            data = decode(data).encode() if decode else data.removeprefix(codecs.BOM_UTF8)
            # A carriage return at the very end may belong to a newline that follows.
            cut = max(data.rfind(b"\n"), data.rfind(b"\r", 0, max(len(data) - 2, 0))) + 1
            if cut:
                yield _with_newlines(b"".join((rest, memoryview(data)[:cut])))
                rest = data[cut:]
            elif len(rest := rest + data) > LONGEST_LINE:
                raise TableError(
                    f"{text.path}, line 1: the line is longer than {LONGEST_LINE} bytes; is the file text?"
                )
    if cut := max(rest.rfind(b"\n"), rest.rfind(b"\r")) + 1:
        yield _with_newlines(rest[:cut])


def _with_newlines(data: bytes) -> bytes:
    return _ENDS.sub(b"\n", data) if b"\r" in data else data


def _encoding(path: Path, head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    before, zero, _ = head.partition(b"\0")
    if zero and not any(head[0::2]):
        return "utf-16-be"
    if zero and not any(head[1::2]):
        return "utf-16-le"
    few_lines = zero and len(_ENDS.findall(before)) < FEWEST_LINES
    if few_lines or len(_CONTROL.findall(before)) > MOST_CONTROL * len(before):
        raise TableError(f"{path}, line 1: the file is not text, and of no format that is known; write it as CSV")
    try:
        codecs.getincrementaldecoder("utf-8-sig")().decode(before)
    except UnicodeDecodeError:
        return "cp1252" if all(byte not in before for byte in (0x81, 0x8D, 0x8F, 0x90, 0x9D)) else "latin-1"
    return "utf-8-sig"


def _bare(encoding: str, head: bytes) -> str:
    """The encoding of a part of the file, which begins with no byte order mark."""
    if encoding == "utf-16":
        return "utf-16-be" if head.startswith(codecs.BOM_UTF16_BE) else "utf-16-le"
    return encoding.removesuffix("-sig")


def _tail(file: IO[bytes]) -> bytes:
    """The end of the file, from a block on in which there is more than bytes 0."""
    begin, tail = file.seek(0, os.SEEK_END), b""
    begin += begin % 2
    while begin > 0 and not tail.strip(b"\0"):
        begin = max(begin - HEAD_BYTES, 0)
        file.seek(begin)
        tail = file.read(HEAD_BYTES)
        if not tail.strip(b"\0"):
            tail = b""
    return tail + b"\0\0" if file.read(1) else tail
