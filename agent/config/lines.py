"""Finds the line of a setting in a TOML text, because tomllib gives values without their lines."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection

Path = tuple[str | int, ...]
"""Path of a setting, such as ("channels", 0, "prior"): names of tables, and numbers of entries in lists."""

# Tokens of a text that is known to be TOML. A string ends at the first quotes before which stands an even number of
# backslashes. Nothing is tried twice, so the time is linear for every text. No group with choices is repeated by *+:
# Python before 3.11.5, as in Debian 12, ends such a repetition at a wrong place.
_TOKEN = re.compile(
    r'''(?P<space>[ \t\r]++|\#[^\n]*+)
      | (?P<newline>\n)
      | (?P<string>""".*?(?<!\\)(?:\\\\)*+"{3,5} | \'\'\'.*?'{3,5} | ".*?(?<!\\)(?:\\\\)*+" | '[^'\n]*+')
      | (?P<bare>[^\s"'#\[\]{},=.]++)
      | (?P<mark>[\[\]{},=.])''',
    re.VERBOSE | re.DOTALL,
)


def lines_of(text: str, wanted: Collection[Path]) -> dict[Path, int]:
    """The line (from 1) of each path. If the setting is missing: the line of the innermost table around it that exists.

    `text` must be TOML that tomllib reads.
    """
    scan = _TokenScan({path[:length] for path in wanted for length in range(len(path) + 1)})
    for token in _TOKEN.finditer(text):
        scan.take(str(token.lastgroup), token[0])
    return {
        path: next(scan.found[path[:n]] for n in range(len(path), -1, -1) if path[:n] in scan.found) for path in wanted
    }


class _TokenScan:
    """Reads token by token. Knows which kind comes next, and the table, lists and inline tables around it."""

    def __init__(self, wanted: Collection[Path]) -> None:
        self.found: dict[Path, int] = {(): 1}
        self._wanted = wanted
        self._line = 1
        self._expected = "key"  # or "value"; "end" until the rest of a value is read
        self._table: Path = ()  # table of the last header
        self._entries: dict[Path, int] = {}  # number of entries so far of each list of tables
        self._inside: list[tuple[Path, int | None]] = []  # a list has the number of its entry, an inline table None
        self._key: list[str] = []
        self._path: Path = ()  # path of the value
        self._brackets = 0  # number of "[" in a header

    def take(self, kind: str, text: str) -> None:
        if kind == "newline":
            self._line += 1
            if not self._inside:
                self._expected, self._key, self._brackets = "key", [], 0
        elif kind == "space":
            return
        elif self._expected == "key":
            self._take_key(kind, text)
        elif self._expected == "value":
            self._take_value(kind, text)
        elif kind == "mark":
            self._take_end(text)
        self._line += text.count("\n") if kind == "string" else 0

    def _take_key(self, kind: str, text: str) -> None:
        if kind != "mark":
            self._key.append(_unquoted(text))
        elif text == "[":
            self._brackets += 1
        elif text == "]":
            self._open_table()
        elif text == "=":
            around = self._inside[-1][0] if self._inside else self._table
            self._path = (*around, *self._key)
            for length in range(len(around) + 1, len(self._path) + 1):
                self._note(self._path[:length])
            self._expected = "value"
        elif text == "}":
            self._take_end(text)

    def _open_table(self) -> None:
        """Take a complete header `[a.b]` or `[[a.b]]`. The name of a list of tables means its newest entry."""
        if self._expected == "end" or not self._key:
            return
        path: Path = ()
        for name in self._key[:-1]:
            path = self._newest((*path, name))
        path = (*path, self._key[-1])
        self._note(path)
        if self._brackets == 2:
            self._entries[path] = self._entries.get(path, 0) + 1
        self._table = self._newest(path)
        self._note(self._table)
        self._expected = "end"

    def _newest(self, path: Path) -> Path:
        return (*path, self._entries[path] - 1) if path in self._entries else path

    def _take_value(self, kind: str, text: str) -> None:
        if (kind, text) == ("mark", "]"):  # an empty list, or one that ends with a comma
            self._take_end(text)
            return
        self._note(self._path)
        if (kind, text) == ("mark", "["):
            self._inside.append((self._path, 0))
            self._path = (*self._path, 0)
        elif (kind, text) == ("mark", "{"):
            self._inside.append((self._path, None))
            self._expected, self._key = "key", []
        else:
            self._expected = "end"

    def _take_end(self, text: str) -> None:
        if text in "]}" and self._inside:
            self._inside.pop()
            self._expected = "end"
        elif text == "," and self._inside:
            around, entry = self._inside[-1]
            if entry is None:
                self._expected, self._key = "key", []
            else:
                self._inside[-1] = (around, entry + 1)
                self._path, self._expected = (*around, entry + 1), "value"

    def _note(self, path: Path) -> None:
        if path in self._wanted:
            self.found.setdefault(path, self._line)


def _unquoted(key: str) -> str:
    return str(tomllib.loads(f"k = {key}")["k"]) if key[0] in "\"'" else key
