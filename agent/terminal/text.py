"""Makes text from outside safe to show. What leaves the program for a terminal, a log or a page goes through here.

Names of devices, strings of USB devices, and everything in a recording or store that somebody else made are text from
outside. A terminal obeys some characters instead of showing them: they can rename the window, hide lines, or write
over a verdict. Each such character is shown as JSON writes it, for example \\u001b, so JSON stays the same JSON.
"""

from __future__ import annotations

import io
import os
import re
import sys
from typing import Any

import click

# Control characters (C0 without tab and line feed, DEL, C1), separators of lines and paragraphs, characters without
# width or that turn the direction of the text, language tags, and halves of surrogate pairs.
LONGEST_IN_FIGURE = 32  # characters
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e0fff]"
)


# With which a cell begins that a spreadsheet calculates: at the beginning, or after what a spreadsheet may take for the
# end of a cell, whatever ends it in the file (OWASP, CSV Injection; the wide forms too).
_FORMULA = re.compile("(^|[,;\t\r\n])(?=[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20])")


def visible(text: str) -> str:
    """The text, in which each character that a terminal obeys is written as \\uXXXX. Tabs and line feeds stay."""
    return _OBEYED.sub(_written, text)


def one_line(text: str) -> str:
    """The same in one line: a line feed in text from outside could pretend to begin a line of our own."""
    return visible(text).replace("\n", "\\n").replace("\t", " ")


def page_text(text: str) -> str:
    """The text for an HTML page: nothing in it is markup, and nothing in it is obeyed."""
    from html import escape  # its table of characters takes 0.5 MB

    return escape(visible(text))


def figure_text(text: str) -> str:
    """The text for a figure: in one line of a bounded length, and without mathematics between dollar signs."""
    text = one_line(text).replace("$", r"\$")
    return text if len(text) <= LONGEST_IN_FIGURE else f"{text[:LONGEST_IN_FIGURE]}…"


def no_formula(text: str) -> str:
    """The text for a table, in which an apostrophe stands before what a spreadsheet would calculate."""
    return _FORMULA.sub(r"\1'", text)


def say(line: str, *, err: bool = False) -> None:
    """Print one line on standard output, or on standard error."""
    click.echo(one_line(line), err=err)


class GuardedStream(io.TextIOWrapper):
    """Standard output or standard error. Whatever is printed there is made visible first, whoever prints it."""

    def write(self, text: str) -> int:
        """Write the text, made visible."""
        super().write(visible(text))
        return len(text)

    def write_as_is(self, text: str) -> int:
        """Write the text without a change: only for what draws on a terminal, and makes text visible itself."""
        return super().write(text)


class _AsIs:
    """A GuardedStream for what draws on a terminal."""

    def __init__(self, stream: GuardedStream) -> None:
        self._stream = stream
        self.write = stream.write_as_is

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def for_drawing(stream: Any) -> Any:
    """The stream for a program part that draws on a terminal and makes text from outside visible itself."""
    return _AsIs(stream) if isinstance(stream, GuardedStream) else stream


def guard_standard_streams() -> None:
    """From now on nothing that this process prints can contain a character that a terminal obeys.

    A standard stream that is closed (`>&-`) is opened to /dev/null. Otherwise the next file that is opened, for example
    a recording, would take its place and get what is printed.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
            os.set_inheritable(descriptor, True)
    sys.stdout = _guarded(sys.stdout, 1)
    sys.stderr = _guarded(sys.stderr, 2)


def _guarded(stream: Any, descriptor: int) -> GuardedStream:
    if not isinstance(stream, io.TextIOWrapper):
        return GuardedStream(open(descriptor, "wb", closefd=False), encoding="utf-8", errors="replace")
    kept = {name: getattr(stream, name) for name in ("encoding", "line_buffering", "write_through")}
    # An output without a plus-minus sign is better than none.
    return GuardedStream(stream.detach(), errors="replace", **kept)


def _written(match: re.Match[str]) -> str:
    code = ord(match[0])
    if code < 0x10000:
        return f"\\u{code:04x}"
    code -= 0x10000
    return f"\\u{0xD800 + (code >> 10):04x}\\u{0xDC00 + (code & 0x3FF):04x}"
