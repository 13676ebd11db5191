"""The console of rich that all commands use: it takes text as it is, without markup, and makes it visible."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from agent.terminal.text import for_drawing, one_line, visible


class TextConsole(Console):
    """Writes to `file`, by default standard output. Only rich's own control sequences reach the terminal."""

    def __init__(self, file: Any = None, *, width: int | None = None) -> None:
        stream = for_drawing(sys.stdout if file is None else file)
        super().__init__(file=stream, width=width, highlight=False, markup=False, emoji=False)

    def print_line(self, text: str) -> None:
        """Print one line, whatever the text is; a terminal may wrap it."""
        self.print(one_line(text), soft_wrap=True)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render, with all text made visible."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)
