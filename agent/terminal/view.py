"""The views of a run: a live screen on a terminal, lines where there is none, or nothing."""

from __future__ import annotations

from typing import Protocol, TextIO

from agent.core.events import Result
from agent.terminal.state import ViewState
from agent.terminal.wording import publication_line, result_lines


class View(Protocol):
    """Shows a ViewState. Neither method raises because of the terminal."""

    def refresh(self, *, now: bool = False) -> None:
        """Show what changed, at most a few times a second unless `now`; may be called at any rate."""

    def close(self) -> None:
        """Show the end state and leave the terminal as it was. May be called twice."""


def open_view(state: ViewState, stream: TextIO, *, lines: bool = True) -> View:
    """A live screen where `stream` is a terminal; elsewhere plain lines, or nothing."""
    if stream.isatty():
        from agent.terminal.screen import Screen

        return Screen(state, stream)
    return Lines(state, stream) if lines else Nothing()


class Nothing:
    """Shows nothing: the log tells it."""

    def refresh(self, *, now: bool = False) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


class Lines:
    """One line for each thing that happens: for logs, pipes and journals."""

    def __init__(self, state: ViewState, stream: TextIO) -> None:
        self._state = state
        self._stream = stream
        self._shown = 0  # sequence of the last result
        self._said = 0
        self._known: dict[str, str] = {}  # topic: last line
        self._write(f"{state.title}, gateway {state.gateway}")

    def refresh(self, *, now: bool = False) -> None:
        """Write what is new."""
        del now  # lines come when things happen, however often
        state = self._state
        new = state.messages_said - self._said
        for message in list(state.messages)[-new:] if new else []:
            self._write(message)
        self._said = state.messages_said
        for name, device in state.devices.items():
            self._tell(f"device {name}", f"{device.kind}, {device.state}")
        if state.recording:
            self._tell("recording", state.recording.path if state.recording.recording else "stopped, the disk refuses")
        if state.publication:
            self._tell("publishing", publication_line(state.publication))
        results: list[Result] = [*state.windows, *state.calibrations.values(), *state.statuses.values()]
        for result in sorted(results, key=lambda r: r.sequence):
            if result.sequence > self._shown:
                self._shown = result.sequence
                for line in result_lines(result, state.truths.get(result.sensor)):
                    self._write(line)

    def close(self) -> None:
        """Write what is left."""
        self.refresh()

    def _tell(self, topic: str, line: str) -> None:
        if self._known.get(topic) != line:
            self._known[topic] = line
            self._write(f"{topic}: {line}")

    def _write(self, line: str) -> None:
        try:
            print(line, file=self._stream, flush=True)
        except (OSError, ValueError):
            return  # whoever read the lines went away; the agent goes on
