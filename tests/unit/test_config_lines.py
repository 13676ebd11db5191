"""The line of a setting, found beside tomllib: every kind of TOML, against a text whose values are their own lines."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from agent.config.lines import Path, lines_of

# Every value is the number of the line that it stands in.
TEXT = """top = 1
# a comment with [brackets] and "quotes" = 2
dotted.name.here = 3
"quoted key.with dots" = 4
'literal' = 5
[ table . "inner one" ]
a = 7
b = [ 8, 8,
  9, # of [ nothing ]
  10,
]
c = { x = 12, y = { z = 12 }, list = [12, 12] }
deep = [[13], [13,
  14], [], [14]]
"with \\"escape" = 15
[[devices]]
n = 17
options = { port = 18, rate = 18 }
[[devices]]
n = 20
[devices.options]
port = 22
[[devices.parts]]
p = 24
[[devices.parts]]
p = 26
[[devices]]
n = 28
[other]
m = 30
e = {}
f = []
g = [
  { h = 34 },
  { h = 35, i = [35,
    36] },
]
"""
WITH_STRINGS = '''a = """
[no.table]
x = 1 \\"""
""""
b = \'\'\'
y = [ \'\'\'
c = "# no comment = ["
d = '\\'
t = 2026-01-02 03:04:05.678
f = -1.5e-3
e = "at"
'''


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, int]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from leaves(item, (*path, name))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from leaves(item, (*path, k))
    else:
        yield path, value


def test_every_value_is_found_in_its_own_line() -> None:
    expected = dict(leaves(tomllib.loads(TEXT)))
    assert len(expected) > 30
    assert lines_of(TEXT, list(expected)) == expected


def test_strings_hide_what_looks_like_toml() -> None:
    expected: dict[Path, int] = {("a",): 1, ("b",): 5, ("c",): 7, ("d",): 8, ("t",): 9, ("f",): 10, ("e",): 11}
    assert set(tomllib.loads(WITH_STRINGS)) == {name for (name,) in expected}
    assert lines_of(WITH_STRINGS, list(expected)) == expected


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("devices",), 16),
        (("devices", 1), 19),
        (("devices", 1, "options"), 21),
        (("devices", 1, "parts", 1), 25),
        (("devices", 2, "driver"), 27),  # not there: the table that lacks it
        (("devices", 2, "options", "port"), 27),
        (("devices", 7), 16),
        (("table", "inner one", "c", "y"), 12),
        (("table", "inner one"), 6),
        (("other", "f", 0), 32),
        (("nothing", "here"), 1),
        ((), 1),
    ],
)
def test_a_table_is_where_it_begins_and_what_is_not_there_where_it_belongs(path: Path, line: int) -> None:
    assert lines_of(TEXT, [path]) == {path: line}


def test_line_ends_of_windows_count_once() -> None:
    assert lines_of(TEXT.replace("\n", "\r\n"), [("devices", 2, "n")]) == {("devices", 2, "n"): 28}
