"""What a run shows to the person at the terminal: the state to be shown, and lines where there is no terminal."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol, TextIO

import numpy as np

from agent.events import CalibrationUpdate, Result, StatusChange, WindowReport
from agent.publication import PublicationState
from agent.quantity import plus_minus, size
from calib.model import Array


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


def open_view(state: ViewState, stream: TextIO) -> View:
    """A live screen where `stream` is a terminal, plain lines elsewhere."""
    if stream.isatty():
        from agent.screen import Screen

        return Screen(state, stream)
    return Lines(state, stream)


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


def result_lines(result: Result, truth: Truth | None) -> list[str]:
    """A result in words."""
    match result:
        case WindowReport():
            return [f"{result.sensor}: window {window_span(result)} at {result.position}: {verdict(result)}"]
        case StatusChange():
            return [f"{result.sensor}: {result.status}{f', {result.reason}' if result.reason else ''}"]
        case CalibrationUpdate():
            lines = [f"{result.sensor}: calibration from {result.windows} windows, {uncertainty_words(result)}"]
            lines += [f"  {row}" for row in calibration_rows(result)]
            return lines + ([f"  {truth_line(result, truth)}"] if truth else [])


def verdict(window: WindowReport) -> str:
    """Used, with its points, or why not."""
    left_out = f", {window.left_out} left out" if window.left_out else ""
    return f"used, {window.points} points{left_out}" if window.used else f"refused: {window.reason}"


def window_span(window: WindowReport) -> str:
    """When the window was, in seconds since the sensor's first sample."""
    return f"{window.start_s:.1f} to {window.stop_s:.1f} s"


def uncertainty_words(calibration: CalibrationUpdate) -> str:
    """What the number after ± is."""
    return f"U with k = {calibration.coverage_factor:.3g}, {calibration.uncertainty_kind}"


def calibration_cells(calibration: CalibrationUpdate) -> list[list[str]]:
    """Three rows x, y, z of S_x, S_y, S_z and Q, each with its expanded uncertainty."""
    expanded = [calibration.coverage_factor * u for u in calibration.standard_uncertainty]
    found = calibration.determined
    rows = []
    for i in range(3):
        cells = [(calibration.sensitivity[i][j], 3 * i + j) for j in range(3)] + [(calibration.offset[i], 9 + i)]
        rows.append([plus_minus(value, expanded[n]) if found[n] else "not known" for value, n in cells])
    return rows


def calibration_rows(calibration: CalibrationUpdate) -> list[str]:
    """The cells as text, one line an axis."""
    names = [(f"S{axis}x", f"S{axis}y", f"S{axis}z", f"Q{axis}") for axis in "xyz"]
    return [
        "  ".join(f"{name} {cell}" for name, cell in zip(row_names, cells, strict=True))
        for row_names, cells in zip(names, calibration_cells(calibration), strict=True)
    ]


def truth_line(calibration: CalibrationUpdate, truth: Truth) -> str:
    """How far S and Q are from the virtual sensor's, S in percent of the row's main sensitivity, Q in m/s2."""
    main = np.diag(truth.sensitivity)
    error = 100 * (np.array(calibration.sensitivity) - truth.sensitivity) / main[:, None]
    found = np.array(calibration.determined)
    error[~found[:9].reshape(3, 3)] = np.nan
    q = np.where(found[9:], (np.array(calibration.offset) - truth.offset) / main, np.nan)
    main_error, transverse = np.diag(error), error[~np.eye(3, dtype=bool)]
    return (
        f"off the truth by at most: S main {_largest(main_error, 3)} %, transverse {_largest(transverse, 3)} %,"
        f" Q {_largest(q, 4)} m/s²"
    )


def publication_line(publication: PublicationState) -> str:
    """What is published where."""
    where = ", ".join(publication.endpoints) or "nowhere"
    link = "connected" if publication.connected else "no router yet, results wait in the store"
    return f"{publication.key}/** to {where} ({publication.fault or link})"


def recording_line(recording: RecordingState) -> str:
    """Where the raw data go."""
    refused = "" if recording.recording else " (the disk refuses: NOT recording)"
    return f"{recording.path}, {size(recording.size_bytes)}{refused}"


def _largest(values: Array, decimals: int) -> str:
    known = values[np.isfinite(values)]
    return f"{np.abs(known).max():.{decimals}f}" if known.size else "–"
