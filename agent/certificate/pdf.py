"""The certificate as PDF, drawn by matplotlib: its fonts are its own, and it loads nothing."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure, SubFigure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from agent.certificate import wording
from agent.certificate.content import ResultCertificate
from agent.certificate.figures import figures_of
from agent.report import style
from agent.terminal.text import one_line

WIDTH_PT, HEIGHT_PT, MARGIN_PT = 595.0, 842.0, 50.0  # A4
SIZE_PT, LEADING_PT = 8.0, 11.0
NAMES_PT = 84.0  # width of the column of names
COLUMNS_PT = (0.0, 40.0, 190.0, 280.0, 335.0, 375.0)  # of the table of parameters, under wording.HEADS
FIGURE_PT = 170.0
SOFT = "#5a6472"
SMALL: Any = {"font.size": 7, "axes.labelsize": 7, "xtick.labelsize": 6, "ytick.labelsize": 6, "legend.fontsize": 6}


def pdf(c: ResultCertificate, signature: str) -> bytes:
    """The pages: two, unless the stated texts are long. A letter that the font does not have is a box."""
    # Type 42 fonts have whole letters, so the text can be searched.
    with style.drawing(), rc_context({"pdf.fonttype": 42}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        sheets = _Pages(c)
        for section in wording.before_results(c, signature):
            sheets.section(section)
        sheets.table("Results", wording.HEADS, wording.parameters(c))
        sheets.turn()
        for section in wording.after_results(c):
            sheets.section(section)
        sheets.figures(c)
        buffer = io.BytesIO()
        with PdfPages(buffer, metadata={"Title": c.number, "CreationDate": None}) as pages:
            for sheet in sheets.numbered():
                pages.savefig(sheet)
        return buffer.getvalue()


class _Pages:
    """Pages that are filled from top to bottom; `_y` is the next line's base in points from the page's lower edge."""

    def __init__(self, c: ResultCertificate) -> None:
        self._number = c.number
        self._pages: list[Figure] = []
        self.turn()
        self._text(MARGIN_PT, c.stated.title, size=15.0, weight="bold")
        self._y -= 24.0

    def turn(self) -> None:
        """Begin a new page."""
        self._pages.append(Figure(figsize=(WIDTH_PT / 72.0, HEIGHT_PT / 72.0)))
        self._y = HEIGHT_PT - MARGIN_PT - 10.0

    def section(self, section: wording.CertificateSection) -> None:
        """A heading and its rows; a row that is too long for one line takes several."""
        self._heading(section.heading)
        for name, text in section.rows:
            lines = list(_wrapped(one_line(text), WIDTH_PT - 2 * MARGIN_PT - NAMES_PT))
            for k, line in enumerate(lines):
                self._need(LEADING_PT)
                if k == 0:
                    self._text(MARGIN_PT, name, color=SOFT)
                self._text(MARGIN_PT + NAMES_PT, line)
                self._y -= LEADING_PT

    def table(self, heading: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table with a line for each row."""
        self._heading(heading)
        for k, row in enumerate((heads, *rows)):
            self._need(LEADING_PT)
            for x, text in zip(COLUMNS_PT, row, strict=True):
                self._text(MARGIN_PT + x, text, color=SOFT if k == 0 else style.INK)
            self._y -= LEADING_PT

    def figures(self, c: ResultCertificate) -> None:
        """Two figures side by side in a row, each with its caption."""
        drawn = figures_of(c)
        for first in range(0, len(drawn), 2):
            self._need(FIGURE_PT + 2 * LEADING_PT)
            row, width = drawn[first : first + 2], (WIDTH_PT - 2 * MARGIN_PT) / 2
            for k, (part, (caption, _, draw)) in enumerate(zip(self._row(len(row)), row, strict=True)):
                with rc_context(SMALL):
                    draw(part, c)
                for n, line in enumerate(_wrapped(caption, width - 16.0)):
                    down_pt = FIGURE_PT + (n + 1) * LEADING_PT
                    self._text(MARGIN_PT + k * width + 8.0, line, down_pt=down_pt, color=SOFT)
            self._y -= FIGURE_PT + 3 * LEADING_PT

    def numbered(self) -> Iterator[Figure]:
        """The pages, each with its number and how many there are."""
        for k, page in enumerate(self._pages, start=1):
            at: Any = {"fontsize": SIZE_PT, "color": SOFT, "parse_math": False}
            page.text(MARGIN_PT / WIDTH_PT, 28.0 / HEIGHT_PT, self._number, **at)
            words = f"page {k} of {len(self._pages)}"
            page.text(1 - MARGIN_PT / WIDTH_PT, 28.0 / HEIGHT_PT, words, ha="right", **at)
            yield page

    def _row(self, count: int) -> Sequence[SubFigure]:
        """Parts of the page, side by side, for figures."""
        page, width = self._pages[-1], (WIDTH_PT - 2 * MARGIN_PT) / 2
        page.subplots_adjust(left=0.17, right=0.97, bottom=0.22, top=0.9, hspace=0.9)  # of each part
        above, below = HEIGHT_PT - self._y, self._y - FIGURE_PT
        grid = page.add_gridspec(
            3, 4, width_ratios=(MARGIN_PT, width, width, MARGIN_PT), height_ratios=(above, FIGURE_PT, below)
        )
        return [page.add_subfigure(grid[1, 1 + k]) for k in range(count)]

    def _heading(self, text: str) -> None:
        self._need(4 * LEADING_PT)
        self._y -= 5.0
        self._text(MARGIN_PT, text, size=10.0, weight="bold")
        self._y -= 1.4 * LEADING_PT

    def _need(self, height_pt: float) -> None:
        if self._y - height_pt < MARGIN_PT - 8.0:
            self.turn()

    def _text(self, x: float, text: str, *, size: float = SIZE_PT, down_pt: float = 0.0, color: str = style.INK,
              weight: str = "normal") -> None:  # fmt: skip
        self._pages[-1].text(x / WIDTH_PT, (self._y - down_pt) / HEIGHT_PT, text, fontsize=size, color=color,
                             fontweight=weight, parse_math=False)  # fmt: skip


def _wrapped(text: str, width_pt: float) -> Iterator[str]:
    """Lines of at most this width; words that are longer than a line are cut."""
    line = ""
    for word in text.split(" "):
        longer = f"{line} {word}" if line else word
        if _width(longer) <= width_pt:
            line = longer
            continue
        if line:
            yield line
        line = word
        while _width(line) > width_pt:
            cut = next(n for n in range(len(line) - 1, 0, -1) if _width(line[:n]) <= width_pt)
            yield line[:cut]
            line = line[cut:]
    yield line


def _width(text: str) -> float:
    font = FontProperties(family="DejaVu Sans", size=SIZE_PT)
    width: float = text_to_path.get_text_width_height_descent(text, font, ismath=False)[0]
    return width
