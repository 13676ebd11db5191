"""The state of a run that the views draw on a terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

from agent.core.events import CalibrationUpdate, Result, StatusChange, WindowReport
from agent.terminal.held import is_held
from agent.terminal.text import one_line
from calib.model import Array

if TYPE_CHECKING:
    from agent.delivery.publication import PublicationState


class ShownTruth(Protocol):
    """True values of a virtual sensor: S (3, 3) in output unit per m/s2, Q (3,) in output unit."""

    @property
    def sensitivity(self) -> Array: ...
    @property
    def offset(self) -> Array: ...


@dataclass
class DeviceState:
    """Present state of a device. `gaps` counts how often samples were lost."""

    kind: str
    state: Literal["opening", "open", "lost"] = "opening"
    rate_hz: float = 0.0
    blocks: int = 0
    gaps: int = 0


@dataclass
class RecordingState:
    """The file that is being written."""

    path: str
    size_bytes: int
    recording: bool  # False after a write to the disk has failed


@dataclass
class ViewState:
    """All values that are shown. The main loop of the agent changes them and refreshes the view in the same thread."""

    title: str
    gateway: str
    uptime_s: float = 0.0
    devices: dict[str, DeviceState] = field(default_factory=dict)
    windows: deque[WindowReport] = field(default_factory=lambda: deque(maxlen=100))
    windows_used: int = 0
    windows_held: int = 0
    windows_refused: int = 0
    calibrations: dict[str, CalibrationUpdate] = field(default_factory=dict)
    statuses: dict[str, StatusChange] = field(default_factory=dict)
    next_steps: dict[str, str] = field(default_factory=dict)  # by sensor: what a person can do next
    truths: dict[str, ShownTruth] = field(default_factory=dict)
    publication: PublicationState | None = None
    recording: RecordingState | None = None
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=50))
    messages_said: int = 0

    def take(self, results: Iterable[Result]) -> None:
        """Take results of the pipeline."""
        for result in results:
            match result:
                case WindowReport():
                    self.windows.append(result)
                    self.windows_used += result.used
                    self.windows_held += is_held(result)
                    self.windows_refused += not result.used and not is_held(result)
                case CalibrationUpdate():
                    self.calibrations[result.sensor] = result
                case StatusChange():
                    self.statuses[result.sensor] = result

    def say(self, message: str) -> None:
        """Add a message line."""
        self.messages.append(one_line(message))
        self.messages_said += 1
