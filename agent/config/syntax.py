"""What is wrong in a text that is not TOML, and the line as it should be written.

The mistakes are those that users report of programs with such files: backslashes of Windows (toml-lang/toml issue 716,
jdx/mise pull request 12330), texts without quotes (oven-sh/bun pull request 36466), and what YAML, INI files, Python
and word processors write otherwise. A correction is proposed only where the corrected line is TOML.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from itertools import count

SHOWN_CHARACTERS = 100  # of a line
LONGEST_LINE, MOST_LINES = 1000, 2000  # which are tried to be corrected
_PLACE = re.compile(r" ?\(at (?:line (\d+), column \d+|end of document)\)")  # as in the messages of tomllib
_TWICE = ("Cannot overwrite", "Cannot declare", "Cannot mutate", "Duplicate")
_ALIKE = str.maketrans(
    dict.fromkeys("\u201c\u201d\u201e\u201f\u00ab\u00bb\u2033", '"')
    | dict.fromkeys("\u2018\u2019\u201a\u2032", "'")
    | dict.fromkeys("\u2212\u2013\u2014", "-")
    | dict.fromkeys("\u00a0\u2007\u2009\u202f", " ")
)
_VALUE_LAST = re.compile(r"""((?:[^#"']|"[^"]*"|'[^']*')*[\w}\]"'])(\s*(?:#.*)?)""")
_NUMBER = r"[-+]?\d[\d_]*(?:\.\d+)?(?:[eE][-+]?\d+)?"
_BEGINS, _ENDS = r"(?<=[=\[,\s])", r"(?=\s*(?:[,}\]#]|$))"  # of a value
_MEANT = {"true": "true", "yes": "true", "on": "true", "false": "false", "no": "false", "off": "false"}


def _dated(found: re.Match[str]) -> str:
    return f"{found['year']}-{int(found['month']):02d}-{int(found['day']):02d}"


def _header(found: re.Match[str]) -> str:
    pairs = len(found[1])
    return "[" * pairs + found[2] + "]" * pairs


_Correction = tuple[str, str, str | Callable[[re.Match[str]], str]]
_CORRECTIONS: tuple[_Correction, ...] = (
    ("typographic quotes, signs and spaces are not TOML's", r"[^\x00-\x7f]", lambda c: c[0].translate(_ALIKE)),
    ("a date is year-month-day", rf"{_BEGINS}(?P<day>\d\d?)\.(?P<month>\d\d?)\.(?P<year>\d{{4}}){_ENDS}", _dated),
    ("month and day have two digits", rf"{_BEGINS}(?P<year>\d{{4}})-(?P<month>\d\d?)-(?P<day>\d\d?){_ENDS}", _dated),
    (
        "a number has no mark of thousands, and no decimal comma; if thousands are meant",
        rf"(?<==)(\s*[-+]?[1-9]\d{{0,2}})[,'\s](\d{{3}}){_ENDS}", r"\1\2",
    ),
    ("a number has a decimal point, not a comma", rf"(?<==)(\s*[-+]?\d+),(\d+){_ENDS}", r"\1.\2"),
    ("a number has a digit before its point", rf"{_BEGINS}([-+]?)\.(\d+){_ENDS}", r"\g<1>0.\2"),
    ("a number has a digit behind its point", rf"{_BEGINS}([-+]?\d+)\.{_ENDS}", r"\1.0"),
    ("a number does not begin with 0", rf"{_BEGINS}([-+]?)0+([1-9][\d.]*){_ENDS}", r"\1\2"),
    (
        "true and false stand in small letters", rf"(?i)(=\s*)(true|false|yes|no|on|off){_ENDS}",
        lambda found: found[1] + _MEANT[found[2].lower()],
    ),
    ("a line ends with its value", r"^(.*\S)\s*[;,]\s*(?:#.*)?$", r"\1"),
    ("a setting without a value is left out", r"(?i)^(.*=\s*(?:none|null|nil|~)?\s*)(?:#.*)?$", r"# \1"),
    ("a comment begins with #", r"^(\s*)(?:;|//)|(?<=\s)(?:;|//)(?=\s)", r"\1#"),
    (
        "a number has no unit; if the setting has this one (docs/reference/configuration.md)",
        rf"(=\s*{_NUMBER})\s*[^\W\d_%]?[a-zA-Z%°µ][\w°%/^.*²-]*{_ENDS}", r"\1",
    ),
    ("a text with \\ stands in single quotes, or has \\\\", r'"([^"\']*\\[^"\']*)"', r"'\1'"),
    ("a text has the same quotes at both ends", r"""(=\s*)(["'])([^"']*)["']?\s*$""", r"\1\2\3\2"),
    ("a section stands in brackets", r"^\s*([\w.-]+):\s*(?=$|#)", r"[\1] "),
    ("= stands between name and value", r"^(\s*[\w.-]+)\s*:=?\s*", r"\1 = "),
    ("= stands between name and value, and a text in quotes", r"^(\s*[\w.-]+)\s*:\s*([^#\"']*\w)", r'\1 = "\2"'),
    ("a name has no blanks", r"^\s*\w+(?: \w+)+(?=\s*=)", lambda found: found[0].replace(" ", "_")),
    ("commas stand between the numbers of a list", rf"({_NUMBER})\s+(?={_NUMBER})", r"\1, "),
    ("a table has one pair of brackets, a list of tables two", r"^\s*(\[{1,2})\s*([\w.]+)\s*\]?\s*$", _header),
    ("a text stands in quotes", r"""(=\s*)([A-Za-z/~.\\][^"'#,}=]*?)(?=\s*(?:[,}#]|$))""", r'\1"\2"'),
)  # fmt: skip


def syntax_fault(text: str, error: ValueError) -> tuple[int, str]:
    """The line of a text that tomllib does not read, and what is wrong there, with the remedy."""
    found, lines = _PLACE.search(str(error)), text.splitlines() or [""]
    number, why = int(found[1]) if found and found[1] else len(lines), _PLACE.sub("", str(error))
    if why.startswith(_TWICE):
        return number, _twice(lines, number)
    for k in (number, *range(1, 0 if found and found[1] else min(number, MOST_LINES))):
        if said := _corrected(lines[k - 1]):
            return k, said
    if (before := _without_comma(lines, number)) is not None:
        return before, f"{_shown(lines[before - 1])}: a comma stands between two entries of a list; add it at the end"
    if (opened := _left_open(lines, number)) is not None:
        return opened, f"{_shown(lines[opened - 1])}: this bracket is not closed; close it"
    what = f"not TOML: {_shown(lines[number - 1])}: {why}" if lines[number - 1].strip() else f"not TOML: {why}"
    return number, f"{what}; a line is name = value, [table] or # comment, and a text stands in quotes"


def _corrected(line: str) -> str:
    """What is wrong in a line, and the line as it should be; "" where no correction makes it TOML."""
    if len(line) > LONGEST_LINE or _reads(line):
        return ""
    for rule, pattern, instead in _CORRECTIONS:
        written = re.sub(pattern, instead, line)
        if written != line and _reads(written):
            return f"{_shown(line)}: {rule}; write {written.strip()}"
    return ""


def _shown(line: str) -> str:
    return line.strip()[:SHOWN_CHARACTERS]


def _reads(line: str) -> bool:
    """Whether a line is TOML by itself, or within a list."""
    for text in (line, f"x = [\n{line}\n]"):
        try:
            tomllib.loads(text)
        except (ValueError, RecursionError):
            continue
        return True
    return False


def _twice(lines: list[str], number: int) -> str:
    """What is there twice, where first, and what to do."""
    line = lines[number - 1].strip()
    if (header := re.match(r"\[+\s*([^\[\]]+?)\s*\]", line)) is None:
        name = line.partition("=")[0].strip()
        pattern, what = rf"\s*{re.escape(name)}\s*=", "remove one of them"
    else:
        name = header[1]
        pattern = rf"\s*\[+\s*{re.escape(name)}\s*[\].]"
        what = f"state all its settings in one place; where there are several, each begins with [[{name}]]"
    first = next((k for k in range(number - 1, 0, -1) if re.match(pattern, lines[k - 1])), None)
    return f"{name} is there twice" + (f", first in line {first}" if first else "") + f"; {what}"


def _without_comma(lines: list[str], number: int) -> int | None:
    """The line before `number` behind whose end a comma is missing: with it, the text is read further; None if none."""
    before = next((k for k in range(number - 1, 0, -1) if not re.match(r"\s*(?:#|$)", lines[k - 1])), None)
    if before is None or not (found := _VALUE_LAST.fullmatch(lines[before - 1])):
        return None
    mended = [*lines[: before - 1], f"{found[1]},{found[2]}", *lines[before:]]
    try:
        tomllib.loads("\n".join(mended))
    except (ValueError, RecursionError) as error:
        place = _PLACE.search(str(error))
        further = place is not None and place[1] is not None and int(place[1]) > number
        return before if further else None
    return before


def _left_open(lines: list[str], until: int) -> int | None:
    """The line with the last bracket that is not closed; None where all are."""
    opened: list[int] = []
    for number, line in zip(count(1), lines[:until], strict=False):
        for mark in re.sub(r""""[^"]*"|'[^']*'|#.*""", "", line):
            if mark in "[{":
                opened.append(number)
            elif mark in "]}" and opened:
                opened.pop()
    return opened[-1] if opened else None
