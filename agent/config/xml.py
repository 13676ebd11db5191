"""XML of strangers: without document types and entities, checked before any parser reads it.

So nothing in it can name another file, and nothing in it expands.
"""

from __future__ import annotations

import re

_DECLARED = re.compile(rb"""^<\?xml[^>]*?encoding\s*=\s*["']([^"']*)["']""")
_FORBIDDEN = re.compile(rb"<!\s*(DOCTYPE|ENTITY)", re.IGNORECASE)
_MARK = b"\xef\xbb\xbf"
ENCODINGS = frozenset([b"utf-8", b"utf8", b"us-ascii", b"ascii", b"iso-8859-1"])  # in which "<!DOCTYPE" is ASCII


class XmlError(ValueError):
    """The XML is not read. The message says why, and the remedy."""


def check_xml(data: bytes) -> bytes:
    """`data` without a byte order mark, if it has no document type and no entity. Raises XmlError."""
    plain = data.removeprefix(_MARK).lstrip()
    declared = _DECLARED.match(plain)
    encoding = declared[1].strip().lower() if declared else b"utf-8"
    if b"\x00" in plain or encoding not in ENCODINGS:
        raise XmlError("the XML is not in UTF-8; write it in UTF-8")
    if found := _FORBIDDEN.search(plain):
        line = plain.count(b"\n", 0, found.start()) + 1
        raise XmlError(f"line {line}: the XML has a document type (DOCTYPE) or an entity, which is not read; remove it")
    return plain
