"""The live screen of a run, drawn with rich from lines of text, which need a third of the time of rich's tables."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import TextIO

from rich.console import Console, ConsoleOptions
from rich.live import Live
from rich.text import Text

from agent.core.events import CalibrationUpdate
from agent.terminal.console import TextConsole
from agent.terminal.quantity import duration
from agent.terminal.state import ViewState
from agent.terminal.text import one_line
from agent.terminal.wording import (
    STATUS_STYLES,
    calibration_cells,
    publication_line,
    recording_line,
    truth_line,
    uncertainty_words,
    verdict,
    window_span,
)
from calib.output_unit import shown_in

REFRESH_S = 0.5  # results come a few times a minute, the clock changes once a second


class Screen:
    """Draws again in the same place. When it is closed, the last picture stays on the terminal."""

    def __init__(self, state: ViewState, stream: TextIO) -> None:
        self._live = Live(
            ScreenPicture(state),
            console=TextConsole(stream),
            auto_refresh=False,
            vertical_overflow="crop",
        )
        self._drawn_s = time.monotonic()
        self._open = True
        with suppress(OSError):
            self._live.start(refresh=True)

    def refresh(self, *, now: bool = False) -> None:
        """Draw the state, but not within REFRESH_S after the last time."""
        if now or time.monotonic() - self._drawn_s >= REFRESH_S:
            self._drawn_s = time.monotonic()
            with suppress(OSError):  # the terminal was closed; the agent goes on
                self._live.refresh()

    def close(self) -> None:
        """Draw a last time and release the terminal."""
        if self._open:
            self._open = False
            with suppress(OSError):
                self._live.stop()


class ScreenPicture:
    """The state as lines for a console of any width and height; windows and messages share the lines that are left."""

    def __init__(self, state: ViewState) -> None:
        self._state = state

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        height = (options.height or options.size.height) - 1  # one line is for the cursor
        top, bottom = self._top(options.max_width), self._bottom()
        room = max(0, height - len(top) - len(bottom))
        messages = list(self._state.messages)[-max(1, room // 3) :] if self._state.messages else []
        lines = [*top, *self._windows(room - len(messages)), *bottom, *(Text(f"› {m}", "magenta") for m in messages)]
        for line in lines[:height]:
            line.no_wrap = True
            line.overflow = "ellipsis"
            yield line

    def _top(self, width: int) -> list[Text]:
        state = self._state
        lines = [
            Text.assemble(
                ("fieldcal", "bold"),
                f"  {state.title}  ",
                (f"gateway {state.gateway}  up {duration(state.uptime_s)}", "dim"),
            )
        ]
        for sensor in sorted(state.statuses.keys() | state.calibrations.keys()):
            lines += [Text(), *self._sensor(sensor, width)]
        lines += [Text(), _heading("device", "kind", "state", "rate", "blocks", "gaps", widths=_DEVICE)]
        for name, device in state.devices.items():
            style = "" if device.state == "open" else "red" if device.state == "lost" else "dim"
            cells = (name, device.kind, device.state, f"{device.rate_hz:.1f} Hz", f"{device.blocks}", f"{device.gaps}")
            lines.append(Text(_row(cells, _DEVICE), style))
        return lines

    def _sensor(self, sensor: str, width: int) -> list[Text]:
        status, calibration = self._state.statuses.get(sensor), self._state.calibrations.get(sensor)
        name = status.status if status else ""
        reason = f"  {one_line(status.reason)}" if status else ""
        lines = [Text.assemble((sensor, "bold"), "  ", (name, STATUS_STYLES.get(name, "cyan")), (reason, "dim"))]
        if sensor in self._state.next_steps:
            told = textwrap.wrap(f"next: {one_line(self._state.next_steps[sensor])}", width - 2)
            lines += [Text(f"  {part}", "bold") for part in told]
        if calibration is None:
            return lines
        return lines + self._calibration(calibration)

    def _calibration(self, calibration: CalibrationUpdate) -> list[Text]:
        lines = [_heading("", "Sx", "Sy", "Sz", "Q", widths=_PARAMETERS)]
        for axis, cells in zip("xyz", calibration_cells(calibration), strict=True):
            lines.append(Text(_row((axis, *cells), _PARAMETERS)))
        lines.append(Text(f"  {shown_in(calibration.output_unit).words}, {uncertainty_words(calibration)}", "dim"))
        lines.append(Text(f"  method {calibration.method}, {calibration.windows} windows", "dim"))
        truth = self._state.truths.get(calibration.sensor)
        if truth is not None:
            lines.append(Text(f"  {truth_line(calibration, truth)}", "cyan"))
        return lines

    def _windows(self, room: int) -> list[Text]:
        state = self._state
        title = f"windows: {state.windows_used} used, {state.windows_held} held, {state.windows_refused} refused"
        lines = [Text(), Text(title, "dim")]
        for window in list(state.windows)[-max(0, room - len(lines)) :] if room > len(lines) else []:
            cells = (window.sensor, window.position, window_span(window), verdict(window))
            lines.append(Text(_row(cells, _WINDOW), "" if window.used else "yellow"))
        return lines[: max(0, room)]

    def _bottom(self) -> list[Text]:
        state = self._state
        lines = [Text()]
        if state.publication:
            well = state.publication.connected and not state.publication.fault
            lines.append(Text(f"publishes  {publication_line(state.publication)}", "" if well else "yellow"))
        if state.recording:
            style = "" if state.recording.recording else "bold red"
            lines.append(Text(f"records    {recording_line(state.recording)}", style))
        return lines


# Widths of columns; negative: aligned to the right; 0: the rest of the line. Rows without the verdict fit into 80
# columns.
_DEVICE = (16, 28, 9, -10, -9, -6)
_PARAMETERS = (3, -18, -18, -18, -18)
_WINDOW = (8, 29, 22, 0)


def _row(cells: tuple[str, ...], widths: tuple[int, ...]) -> str:
    return "".join(_fit(cell, width) for cell, width in zip(cells, widths, strict=True))


def _fit(cell: str, width: int) -> str:
    cell = one_line(cell)
    if width == 0:
        return cell
    if len(cell) >= abs(width):
        cell = f"{cell[: abs(width) - 2]}…"
    return f"{cell:<{width}}" if width > 0 else f"{cell:>{-width}}"


def _heading(*cells: str, widths: tuple[int, ...]) -> Text:
    return Text(_row(cells, widths), "dim")
