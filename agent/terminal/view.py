"""What a run shows to the person at the terminal: the state to be shown, and lines where there is no terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol, TextIO

from agent.events import CalibrationUpdate, Result, StatusChange, WindowReport
from agent.terminal.wording import publication_line, result_lines
from calib.model import Array

if TYPE_CHECKING:
    from agent.delivery.publication import PublicationState


class Truth(Protocol):
    """What a virtual sensor really has: S (3, 3) in output unit per m/s2, Q (3,) in output unit."""

    @property
    def sensitivity(self) -> Array: ...
    @property
    def offset(self) -> Array: ...


@dataclass
class DeviceState:
    """A device as it is now. `gaps` counts the times samples were lost."""

    kind: str
    state: Literal["opening", "open", "lost"] = "opening"
    rate_hz: float = 0.0
    blocks: int = 0
    gaps: int = 0


@dataclass
class RecordingState:
    """The file being written."""

    path: str
    size_bytes: int
    recording: bool  # false where the disk refuses


@dataclass
class ViewState:
    """All that is shown. The agent's main loop changes it and refreshes the view from the same thread."""

    title: str
    gateway: str
    uptime_s: float = 0.0
    devices: dict[str, DeviceState] = field(default_factory=dict)
    windows: deque[WindowReport] = field(default_factory=lambda: deque(maxlen=100))
    windows_used: int = 0
    windows_refused: int = 0
    calibrations: dict[str, CalibrationUpdate] = field(default_factory=dict)
    statuses: dict[str, StatusChange] = field(default_factory=dict)
    truths: dict[str, Truth] = field(default_factory=dict)
    publication: PublicationState | None = None
    recording: RecordingState | None = None
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=50))
    messages_said: int = 0

    def take(self, results: Iterable[Result]) -> None:
        """What the pipeline found."""
        for result in results:
            match result:
                case WindowReport():
                    self.windows.append(result)
                    self.windows_used += result.used
                    self.windows_refused += not result.used
                case CalibrationUpdate():
                    self.calibrations[result.sensor] = result
                case StatusChange():
                    self.statuses[result.sensor] = result

    def say(self, message: str) -> None:
        """A line for the person who watches."""
        self.messages.append(message)
        self.messages_said += 1


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
