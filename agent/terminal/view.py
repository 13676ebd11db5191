"""The views of a run: a live screen on a terminal, lines of text without a terminal, or nothing."""

from __future__ import annotations

from typing import Protocol, TextIO

from agent.core.events import Result
from agent.terminal.state import ViewState
from agent.terminal.text import one_line
from agent.terminal.wording import publication_line, result_lines


class View(Protocol):
    """Shows a ViewState. The methods raise no error if the terminal fails."""

    def refresh(self, *, now: bool = False) -> None:
        """Show changes: at once if `now`, otherwise at most a few times a second. It may be called at any rate."""

    def close(self) -> None:
        """Show the last state and reset the terminal. It may be called twice."""


def open_view(state: ViewState, stream: TextIO, *, lines: bool = True) -> View:
    """A live screen if `stream` is a terminal; otherwise plain lines, or nothing."""
    if stream.isatty():
        from agent.terminal.screen import Screen

        return Screen(state, stream)
    return LineView(state, stream) if lines else Nothing()


class Nothing:
    """Shows nothing, because the log has all messages."""

    def refresh(self, *, now: bool = False) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class LineView:
    """Writes one line for each event: for logs, pipes and journals."""

    def __init__(self, state: ViewState, stream: TextIO) -> None:
        self._state = state
        self._stream = stream
        self._shown = 0  # sequence number of the last result that was shown
        self._said = 0
        self._known: dict[str, str] = {}  # key: topic; value: its last line
        self._write(f"{state.title}, gateway {state.gateway}")

    def refresh(self, *, now: bool = False) -> None:
        """Write lines for everything that has changed."""
        del now  # each line is written at once
        state = self._state
        new = state.messages_said - self._said
        for message in list(state.messages)[-new:] if new else []:
            self._write(message)
        self._said = state.messages_said
        for name, device in state.devices.items():
            self._tell(f"device {name}", f"{device.kind}, {device.state}")
        if state.recording:
            self._tell(
                "recording",
                state.recording.path if state.recording.recording else "stopped: writing to the disk failed",
            )
        if state.publication:
            self._tell("publishing", publication_line(state.publication))
        results: list[Result] = [*state.windows, *state.calibrations.values(), *state.statuses.values()]
        for result in sorted(results, key=lambda r: r.sequence):
            if result.sequence > self._shown:
                self._shown = result.sequence
                for line in result_lines(result, state.truths.get(result.sensor)):
                    self._write(line)
        for sensor, step in state.next_steps.items():
            self._tell(f"{sensor}: next", step)

    def close(self) -> None:
        """Write the lines that are not yet written."""
        self.refresh()

    def _tell(self, topic: str, line: str) -> None:
        if self._known.get(topic) != line:
            self._known[topic] = line
            self._write(f"{topic}: {line}")

    def _write(self, line: str) -> None:
        try:
            print(one_line(line), file=self._stream, flush=True)
        except (OSError, ValueError):
            return  # the reader of the lines was closed; the agent goes on
